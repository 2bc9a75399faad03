"""The update of SAC in PyTorch's eager mode, as one would write it: prints updates a second.

Arguments: network (simba or mlp), width, batch, threads, precision (fp32 or bf16 autocast), seconds.
"""

import contextlib
import math
import sys
import time

import torch
from torch import nn
from torch.nn import functional as F

network, width, batch, threads, precision, seconds = sys.argv[1:]
width, batch = int(width), int(batch)
torch.set_num_threads(int(threads))
torch.manual_seed(0)
OBSERVATION, ACTION, GAMMA_N, TAU = 68, 21, 0.97, 0.005


class Block(nn.Module):
    def __init__(self, width):
        super().__init__()
        self.norm, self.up, self.down = nn.LayerNorm(width), nn.Linear(width, 4 * width), nn.Linear(4 * width, width)

    def forward(self, x):
        return x + self.down(F.relu(self.up(self.norm(x))))


def body(inputs, blocks):
    if network == "simba":
        return nn.Sequential(nn.Linear(inputs, width), *(Block(width) for _ in range(blocks)), nn.LayerNorm(width))
    return nn.Sequential(nn.Linear(inputs, width), nn.ReLU(), nn.Linear(width, width), nn.ReLU())


class Actor(nn.Module):
    def __init__(self):
        super().__init__()
        self.body = body(OBSERVATION, 1)
        self.mean, self.log_std = nn.Linear(width, ACTION), nn.Linear(width, ACTION)

    def forward(self, observation, beta):
        features = self.body(observation)
        mean, log_std = self.mean(features).float(), self.log_std(features).float().tanh()
        log_std = (log_std + 1) * 3.5 - 5
        noise = torch.randn_like(mean)
        u = mean + log_std.exp() * noise
        log_normal = -0.5 * noise.square() - log_std - 0.5 * math.log(2 * math.pi)
        log_slope = 2 * (math.log(2) - u - F.softplus(-2 * u))
        return beta * u.tanh(), (log_normal - log_slope - beta.log()).sum(1)


class Critic(nn.Module):
    def __init__(self):
        super().__init__()
        self.body, self.value = body(OBSERVATION + ACTION, 2), nn.Linear(width, 1)

    def forward(self, observation, action):
        return self.value(self.body(torch.cat([observation, action], 1))).float().squeeze(1)


actor = Actor()
critics = nn.ModuleList(Critic() for _ in range(1 if network == "simba" else 2))
targets = nn.ModuleList(Critic() for _ in critics)
targets.load_state_dict(critics.state_dict())
decay = 0.01 if network == "simba" else 0.0
actor_adam = torch.optim.AdamW(actor.parameters(), 3e-4, weight_decay=decay, fused=True)
critics_adam = torch.optim.AdamW(critics.parameters(), 3e-4, weight_decay=decay, fused=True)
log_alpha = torch.zeros(1, requires_grad=True)
alpha_adam = torch.optim.Adam([log_alpha], 3e-4)
observation, next_observation = torch.rand(2, batch, OBSERVATION) * 2 - 1
action, reward = torch.rand(batch, ACTION) * 2 - 1, torch.rand(batch)
beta, discount = torch.ones(batch, 1), torch.full((batch,), GAMMA_N)
products = (lambda: torch.autocast("cpu", torch.bfloat16)) if precision == "bf16" else contextlib.nullcontext


def update():
    alpha = log_alpha.exp().detach()
    with products():
        with torch.no_grad():
            next_action, next_log_prob = actor(next_observation, beta)
            next_q = torch.stack([target(next_observation, next_action) for target in targets]).amin(0)
            y = reward + discount * (next_q - alpha * next_log_prob)
        critic_loss = sum(F.mse_loss(critic(observation, action), y) for critic in critics)
    critics_adam.zero_grad()
    critic_loss.backward()
    critics_adam.step()
    critics.requires_grad_(False)
    with products():
        sample, log_prob = actor(observation, beta)
        q = torch.stack([critic(observation, sample) for critic in critics]).amin(0)
        actor_loss = (alpha * log_prob - q).mean()
    actor_adam.zero_grad()
    actor_loss.backward()
    actor_adam.step()
    critics.requires_grad_(True)
    alpha_adam.zero_grad()
    (log_alpha.exp() * (-log_prob.detach().mean() + ACTION)).sum().backward()
    alpha_adam.step()
    with torch.no_grad():
        torch._foreach_lerp_(list(targets.parameters()), list(critics.parameters()), TAU)


for _ in range(5):
    update()
count, start = 0, time.perf_counter()
while time.perf_counter() - start < float(seconds):
    update()
    count += 1
print(count / (time.perf_counter() - start))
