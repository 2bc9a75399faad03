"""Records SAC updates of a tiny network by PyTorch, as `sac_update.json`, for the test of the same name.

Run with a Python that has PyTorch: `.native/peers/bin/python learner/tests/data/sac_update.py` after
`cargo xtask setup --peers`. The equations are those of App. D of Learning to Get Up, with autograd and
torch.optim.Adam, and nothing of this project's code.
"""

import json
import math
import pathlib

import torch

torch.manual_seed(20220)
torch.set_num_threads(1)
OBSERVATION, ACTION, HIDDEN, BATCH, UPDATES = 3, 2, 4, 5, 3
GAMMA, TAU, TARGET_ENTROPY = 0.97, 0.005, -2.0
ACTOR_LR, CRITIC_LR, TEMPERATURE_LR = 1e-3, 2e-3, 3e-3


def layer(inputs, outputs):
    return torch.nn.Linear(inputs, outputs)


class Actor(torch.nn.Module):
    def __init__(self):
        super().__init__()
        self.body = torch.nn.ModuleList([layer(OBSERVATION, HIDDEN), layer(HIDDEN, HIDDEN)])
        self.head = torch.nn.ModuleDict({"mean": layer(HIDDEN, ACTION), "log_std": layer(HIDDEN, ACTION)})

    def sample(self, observation, beta, noise):
        for module in self.body:
            observation = torch.relu(module(observation))
        log_std = -5 + 0.5 * (2 + 5) * (torch.tanh(self.head["log_std"](observation)) + 1)
        mean = self.head["mean"](observation)
        u = mean + log_std.exp() * noise
        density = torch.distributions.Normal(mean, log_std.exp())
        slope = beta * (1 - torch.tanh(u) ** 2)
        return beta * torch.tanh(u), (density.log_prob(u) - slope.log()).sum(1)


class Critic(torch.nn.Module):
    def __init__(self):
        super().__init__()
        self.body = torch.nn.ModuleList([layer(OBSERVATION + ACTION, HIDDEN), layer(HIDDEN, HIDDEN)])
        self.head = torch.nn.ModuleDict({"value": layer(HIDDEN, 1)})

    def forward(self, observation, action):
        x = torch.cat([observation, action], 1)
        for module in self.body:
            x = torch.relu(module(x))
        return self.head["value"](x).squeeze(1)


def tensors(module):
    return {name: tensor.detach().flatten().tolist() for name, tensor in module.state_dict().items()}


actor = Actor()
critics, targets = torch.nn.ModuleList([Critic(), Critic()]), torch.nn.ModuleList([Critic(), Critic()])
targets.load_state_dict(critics.state_dict())
log_alpha = torch.tensor(math.log(0.1), requires_grad=True)
actor_adam = torch.optim.Adam(actor.parameters(), lr=ACTOR_LR)
critic_adam = torch.optim.Adam(critics.parameters(), lr=CRITIC_LR)
alpha_adam = torch.optim.Adam([log_alpha], lr=TEMPERATURE_LR)
record = {"actor": tensors(actor), "critics": tensors(critics), "updates": []}

for _ in range(UPDATES):
    batch = {
        "observation": torch.randn(BATCH, OBSERVATION),
        "action": torch.rand(BATCH, ACTION) - 0.5,
        "reward": torch.rand(BATCH),
        "next_observation": torch.randn(BATCH, OBSERVATION),
        "discount": GAMMA * (torch.rand(BATCH) > 0.2).float(),
        "beta": 0.4 + 0.6 * torch.rand(BATCH, 1),
    }
    next_noise, noise = torch.randn(BATCH, ACTION), torch.randn(BATCH, ACTION)
    alpha = log_alpha.exp()
    with torch.no_grad():
        action, log_prob = actor.sample(batch["next_observation"], batch["beta"], next_noise)
        q = torch.min(*(target(batch["next_observation"], action) for target in targets))
        y = batch["reward"] + batch["discount"] * (q - alpha * log_prob)
    critic_loss = sum(torch.nn.functional.mse_loss(c(batch["observation"], batch["action"]), y) for c in critics)
    critic_adam.zero_grad()
    critic_loss.backward()
    critic_adam.step()
    action, log_prob = actor.sample(batch["observation"], batch["beta"], noise)
    q = torch.min(*(critic(batch["observation"], action) for critic in critics))
    actor_loss = (alpha.detach() * log_prob - q).mean()
    actor_adam.zero_grad()
    actor_loss.backward()
    actor_adam.step()
    alpha_loss = (log_alpha.exp() * (-log_prob - TARGET_ENTROPY).detach()).mean()
    alpha_adam.zero_grad()
    alpha_loss.backward()
    alpha_adam.step()
    with torch.no_grad():
        for target, source in zip(targets.parameters(), critics.parameters()):
            target.lerp_(source, TAU)
    record["updates"].append(
        {
            "batch": {name: tensor.flatten().tolist() for name, tensor in batch.items()},
            "next_noise": next_noise.flatten().tolist(),
            "noise": noise.flatten().tolist(),
            "critic_loss": critic_loss.item(),
            "actor_loss": actor_loss.item(),
            "entropy": -log_prob.mean().item(),
            "actor": tensors(actor),
            "critics": tensors(critics),
            "targets": tensors(targets),
            "log_alpha": log_alpha.item(),
        }
    )

pathlib.Path(__file__).with_suffix(".json").write_text(json.dumps(record))
