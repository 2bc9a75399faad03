"""The policy's forward pass in PyTorch, on one thread: for every batch size that it reads, it prints passes a second of
eager mode or of a frozen trace, whichever is faster.

Arguments: network (simba or mlp), width, seconds that each of the two is measured.
"""

import sys
import time

import torch
from torch import nn
from torch.nn import functional as F

network, width, seconds = sys.argv[1], int(sys.argv[2]), float(sys.argv[3])
torch.set_num_threads(1)
torch.manual_seed(0)
OBSERVATION, ACTION = 68, 21


class Block(nn.Module):
    def __init__(self):
        super().__init__()
        self.norm, self.up, self.down = nn.LayerNorm(width), nn.Linear(width, 4 * width), nn.Linear(4 * width, width)

    def forward(self, x):
        return x + self.down(F.relu(self.up(self.norm(x))))


class Normalize(nn.Module):
    def __init__(self):
        super().__init__()
        self.register_buffer("mean", torch.zeros(OBSERVATION))
        self.register_buffer("std", torch.ones(OBSERVATION))

    def forward(self, x):
        return ((x - self.mean) / self.std).clamp(-10, 10)


def body():
    if network == "simba":
        return nn.Sequential(Normalize(), nn.Linear(OBSERVATION, width), Block(), nn.LayerNorm(width))
    return nn.Sequential(nn.Linear(OBSERVATION, width), nn.ReLU(), nn.Linear(width, width), nn.ReLU())


class Policy(nn.Module):
    def __init__(self):
        super().__init__()
        self.body, self.mean, self.log_std = body(), nn.Linear(width, ACTION), nn.Linear(width, ACTION)

    def forward(self, observation):
        features = self.body(observation)
        return self.mean(features), (self.log_std(features).tanh() + 1) * 3.5 - 5


def rate(policy, observation):
    with torch.inference_mode():
        for _ in range(20):
            policy(observation)
        count, elapsed, start = 0, 0.0, time.perf_counter()
        while elapsed < seconds:
            policy(observation)
            count += 1
            elapsed = time.perf_counter() - start
    return count / elapsed


eager = Policy().eval()
for line in sys.stdin:
    observation = torch.rand(int(line), OBSERVATION) * 2 - 1
    with torch.no_grad():
        frozen = torch.jit.freeze(torch.jit.trace(eager, observation))
    print(max(rate(eager, observation), rate(frozen, observation)), flush=True)
