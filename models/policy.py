"""A controller of this folder in NumPy: `python policy.py strong.safetensors` prints what it does in a state of rest.

The observation is 68 numbers (README.md says which), the last of them β̂; the action is 21 numbers in [-β̂, β̂], in units
of the joints' torque limits.
"""

import json
import sys

import numpy as np


def load(path):
    """Tensors by name, and the file's metadata."""
    data = open(path, "rb").read()
    begin = 8 + int.from_bytes(data[:8], "little")
    header = json.loads(data[8:begin])
    metadata = json.loads(header.pop("__metadata__")["getup"])
    array = lambda entry: np.frombuffer(data[begin:][slice(*entry["data_offsets"])], "<f4").reshape(entry["shape"])
    return {name: array(entry) for name, entry in header.items()}, metadata


def act(tensors, metadata, observation):
    """The mean action: β̂ tanh(mean)."""
    linear = lambda name, x: tensors[name + ".weight"] @ x + tensors[name + ".bias"]
    norm = lambda name, x: (x - x.mean()) / np.sqrt(x.var() + 1e-5) * tensors[name + ".weight"] + tensors[name + ".bias"]
    x = (observation - tensors["observation.mean"]) / tensors["observation.std"]
    x = linear("body.embed", np.clip(x, -metadata["clip"], metadata["clip"]))
    for block in range(metadata["shape"]["body"]["blocks"]):
        inner = np.maximum(linear(f"body.{block}.up", norm(f"body.{block}.norm", x)), 0)
        x = x + linear(f"body.{block}.down", inner)
    return observation[-1] * np.tanh(linear("head.mean", norm("body.norm", x)))


if __name__ == "__main__":
    tensors, metadata = load(sys.argv[1])
    observation = np.zeros(68, dtype=np.float32)
    observation[-1] = float(metadata["metadata"]["beta"])
    print(act(tensors, metadata, observation))
