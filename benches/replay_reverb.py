"""DeepMind Reverb at the work of our replay service: the peer of `cargo xtask bench replay`.

    replay_reverb.py SETTINGS MAX_SIZE     answers requests, a line of JSON each, until its input ends
    replay_reverb.py --sweep SETTINGS      finds this machine's best settings, in a quarter of an hour

    {"insert": {"writers": 8, "seconds": 4}}  -> {"per_second": transitions, "p50": seconds, "p99": seconds}
    {"sample": {"batch": 256, "seconds": 4}}  -> {"per_second": transitions, "p50": seconds, "p99": seconds}
    {"memory": {"transitions": 1000000}}      -> {"bytes": resident, "empty_bytes": resident before the first insert}
    {"restart": {}}                           -> {"seconds": until it serves again, "checkpoint_seconds": to save}

A transition is an item of one table: two observations, an action, a reward and β, of an episode of 250 steps. The
table samples uniformly, drops the oldest and lets nobody wait. The server, the sampler and each writer are processes of
their own and speak gRPC over loopback. Between requests all of them rest.

Where there was a choice, it favours Reverb:
- Every row has its own best settings, even its own chunk length, though a table in use has but one. They come from the
  sweep, which tries StructuredWriter too (chunk length null: it cuts its chunks itself, and makes the items in C++).
- The rate of inserts is measured with `in_flight` of them unconfirmed; the latency apart from it, in the second half of
  the time: how long 64 steps take to be confirmed when nothing else of their writer is on its way.
- Reverb confirms what is in its memory and loses it with the process; ours confirms what survives that.
- The writers' steps are made beforehand, and not validated against the table's signature.
- Samples come from a full table through tf.data, which batches and prefetches; it is warm when its time begins.
- A restart loads from the page cache, and starting Python and TensorFlow is not part of it.

The steps are noise: a compressor gains as little on the floats of the simulation, and Reverb's is Snappy. Resident
memory includes TensorFlow, without which Reverb does not run: `empty_bytes` says how much that is.
"""

import functools
import importlib.metadata
import itertools
import json
import math
import multiprocessing
import os
import random
import shutil
import statistics
import sys
import tempfile
import threading
import time
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

os.environ["TF_CPP_MIN_LOG_LEVEL"] = "3"
os.environ["CUDA_VISIBLE_DEVICES"] = "-1"

import numpy as np
import reverb
import tensorflow as tf

TABLE = "transitions"
SHAPES = {"observation": (68,), "action": (21,), "reward": (), "beta": ()}
EPISODE, FLUSH_EVERY, MOST_WRITERS = 250, 64, 8
# What the sweep tries; in flight are items of a writer, or samples of a sampler's worker.
CHUNK_LENGTHS, IN_FLIGHT, WORKERS = (None, 1, 5, 25, 50, 125), (64, 256, 1024), (1, 2, 4)
SWEEP_SIZE, SWEEP_SECONDS = 50_000, 0.8

# A forked writer finds TensorFlow imported, which takes seconds; a forked server would hide what TensorFlow takes.
FORK, SPAWN = multiprocessing.get_context("forkserver"), multiprocessing.get_context("spawn")
FORK.set_forkserver_preload(["reverb", "tensorflow"])

Setting = dict[str, Any]


def begin_child() -> None:
    """Drops what Reverb logs, not what Python does: it warns whoever has 50 items in flight, thousands of times a
    second. And ends this process with its parent, however that ends."""
    sys.stderr = os.fdopen(os.dup(2), "w")
    os.dup2(os.open(os.devnull, os.O_WRONLY), 2)
    parent = multiprocessing.parent_process()
    threading.Thread(target=lambda: (parent.join(), os._exit(1)), daemon=True).start()


def transition(steps: Any) -> dict[str, Any]:
    """The newest transition in a writer's history, or as a structured writer's pattern."""
    return {"observation": steps["observation"][-2:]} | {key: steps[key][-2] for key in ("action", "reward", "beta")}


def serve(connection: Connection, max_size: int, folder: str) -> None:
    begin_child()
    shapes = SHAPES | {"observation": (2, *SHAPES["observation"])}
    table = reverb.Table(
        name=TABLE,
        sampler=reverb.selectors.Uniform(),
        remover=reverb.selectors.Fifo(),
        max_size=max_size,
        max_times_sampled=0,
        rate_limiter=reverb.rate_limiters.MinSize(1),
        signature={key: tf.TensorSpec(shape, tf.float32) for key, shape in shapes.items()},
    )
    began = time.monotonic()
    server = reverb.Server([table], checkpointer=reverb.checkpointers.DefaultCheckpointer(folder))
    connection.send((server.port, began))
    server.wait()


class Server:
    """A Reverb server in a process of its own, and the folder of its checkpoint."""

    def __init__(self, max_size: int) -> None:
        self.max_size, self.folder = max_size, tempfile.TemporaryDirectory()
        self.start()
        self.empty_bytes = self.resident()

    def start(self) -> float:
        """Starts it, from its checkpoint if it has one. Returns the monotonic time at which it began to load."""
        ours, theirs = SPAWN.Pipe()
        self.process = SPAWN.Process(target=serve, args=(theirs, self.max_size, self.folder.name), daemon=True)
        self.process.start()
        theirs.close()
        port, began = ours.recv()
        self.address = f"localhost:{port}"
        self.client = reverb.Client(self.address)
        return began

    def kill(self) -> None:
        self.process.kill()
        self.process.join()

    def restart(self) -> dict[str, float]:
        size, began = self.size(), time.monotonic()
        checkpoint = self.client.checkpoint()
        checkpoint_seconds = time.monotonic() - began
        self.kill()
        began = self.start()
        while self.size() < size:
            time.sleep(0.01)
        seconds = time.monotonic() - began
        shutil.rmtree(checkpoint)  # now, as this process may be killed
        return {"seconds": seconds, "checkpoint_seconds": checkpoint_seconds}

    def size(self) -> int:
        return self.client.server_info()[TABLE].current_size

    def resident(self) -> int:
        status = Path(f"/proc/{self.process.pid}/status").read_text()
        return 1024 * int(status.split("VmRSS:")[1].split()[0])


def open_writer(client: reverb.Client, chunk_length: int | None) -> tuple[Any, Callable[[Any], None]]:
    """A writer, and how to give it a step: from an episode's second one on, each completes a transition."""
    if chunk_length is None:
        pattern = transition(reverb.structured.create_reference_step(dict.fromkeys(SHAPES)))
        writer = client.structured_writer([reverb.structured.create_config(pattern, TABLE)])
        return writer, writer.append
    alive = max(chunk_length, 2)
    writer = client.trajectory_writer(alive, validate_items=False)
    for key in SHAPES:
        writer.configure((key,), num_keep_alive_refs=alive, max_chunk_length=chunk_length)

    def append(step: Any) -> None:
        writer.append(step)
        if writer.episode_steps > 1:
            writer.create_item(TABLE, 1.0, transition(writer.history))

    return writer, append


def write(
    address: str, setting: Setting, start: float, seconds: float, transitions: float
) -> tuple[int, float, list[float]]:
    """Transitions inserted, the time at which the last of them was confirmed, and how long each flush took."""
    noise = np.random.default_rng()
    steps = range(EPISODE + 1)  # the last one brings the last observation
    episode = [{key: noise.random(shape, np.float32) for key, shape in SHAPES.items()} for _ in steps]
    writer, append = open_writer(reverb.Client(address), setting["chunk_length"])
    count, flushes = 0, []
    time.sleep(max(0.0, start - time.monotonic()))
    for step in itertools.cycle(steps):
        append(episode[step])
        count += step > 0
        if step > 0 and count % FLUSH_EVERY == 0:
            began = time.perf_counter()
            writer.flush(setting["in_flight"])
            flushes.append(time.perf_counter() - began)
        if step == EPISODE:
            writer.end_episode()
        if count >= transitions or time.monotonic() >= start + seconds:
            break
    writer.flush()
    return count, time.monotonic(), flushes


class Writers:
    """The processes that write."""

    def __init__(self) -> None:
        self.pool = ProcessPoolExecutor(MOST_WRITERS, FORK, begin_child)
        # A process starts when a task finds no idle one: have them all now, so that none starts on the clock.
        list(self.pool.map(time.sleep, [0.5] * MOST_WRITERS))

    def insert(
        self, server: Server, setting: Setting, writers: int, seconds: float = math.inf, transitions: float = math.inf
    ) -> tuple[float, list[float]]:
        """Transitions a second of writers that begin together, and how long their flushes took."""
        start = time.monotonic() + 0.5  # they have connected by then
        work = functools.partial(write, server.address, setting, start, seconds)
        counts, ends, flushes = zip(*self.pool.map(work, [transitions / writers] * writers))
        return sum(counts) / (max(ends) - start), list(itertools.chain(*flushes))

    def fill(self, server: Server, chunk_length: int | None, transitions: int) -> None:
        self.insert(server, {"chunk_length": chunk_length, "in_flight": 256}, 2, transitions=transitions)


def sample(server: Server, setting: Setting, batch: int, seconds: float) -> tuple[float, list[float]]:
    """Transitions sampled a second, and how long each minibatch took."""
    dataset = reverb.TrajectoryDataset.from_table_signature(
        server.address,
        TABLE,
        max_in_flight_samples_per_worker=setting["in_flight"],
        num_workers_per_iterator=setting["workers"],
    )
    batches = iter(dataset.batch(batch, drop_remainder=True).prefetch(2))

    def take(seconds: float) -> list[float]:
        moments = [time.perf_counter()]
        while moments[-1] - moments[0] < seconds:
            next(batches)
            moments.append(time.perf_counter())
        return [after - before for before, after in itertools.pairwise(moments)]

    take(0.3)
    times = take(seconds)
    return batch * len(times) / sum(times), times


class Peer:
    """Answers requests with the best settings, from one server at a time."""

    def __init__(self, best: dict[str, Setting], max_size: int) -> None:
        self.best, self.max_size, self.writers = best, max_size, Writers()
        self.server, self.holds = None, None

    def answer(self, request: dict[str, Any]) -> dict[str, float]:
        match request:
            case {"insert": {"writers": writers, "seconds": seconds}}:
                setting = self.best[f"insert {writers}"]
                server = self.server_with(setting["chunk_length"], 0)
                rate, _ = self.writers.insert(server, setting, writers, seconds / 2)
                _, flushes = self.writers.insert(server, setting | {"in_flight": 0}, writers, seconds / 2)
                return with_percentiles(rate, flushes)
            case {"sample": {"batch": batch, "seconds": seconds}}:
                setting = self.best[f"sample {batch}"]
                server = self.server_with(setting["chunk_length"], self.max_size)
                return with_percentiles(*sample(server, setting, batch, seconds))
            case {"memory": {"transitions": transitions}}:
                server = self.server_with(self.best["memory"]["chunk_length"], transitions)
                return {"bytes": server.resident(), "empty_bytes": server.empty_bytes}
            case {"restart": {}}:
                return (self.server or self.server_with(self.best["memory"]["chunk_length"], self.max_size)).restart()
        raise ValueError(f"neither insert, sample, memory nor restart: {request}")

    def server_with(self, chunk_length: int | None, transitions: int) -> Server:
        """The server there is, if it was filled just so; else a new one."""
        if self.holds != (chunk_length, transitions):
            if self.server:
                self.server.kill()
            self.server, self.holds = Server(self.max_size), (chunk_length, transitions)
            if transitions:
                self.writers.fill(self.server, chunk_length, transitions)
        return self.server


def with_percentiles(rate: float, times: list[float]) -> dict[str, float]:
    p50, p99 = np.percentile(times, [50, 99])
    return {"per_second": rate, "p50": p50, "p99": p99}


def contest(kind: str, measure: Callable[[Setting], float], **choices: tuple[Any, ...]) -> list[dict[str, Any]]:
    """Measures all combinations of the choices in random order, the better half of them again, and so on, with a turn
    more each time: on a busy machine it takes many to tell the good ones apart. The best median comes first."""
    settings = [dict(zip(choices, values)) for values in itertools.product(*choices.values())]
    rows = [{"kind": kind, "setting": setting, "per_second": []} for setting in settings]
    remaining, turns = len(rows), 1
    while remaining > 1:
        for row in random.sample(rows[:remaining] * turns, remaining * turns):
            row["per_second"].append(round(measure(row["setting"])))
        rows[:remaining] = sorted(rows[:remaining], key=lambda row: -statistics.median(row["per_second"]))
        remaining, turns = math.ceil(remaining / 2), turns + 1
    return rows


def sweep() -> dict[str, Any]:
    load = round(os.getloadavg()[0], 1)
    writers, servers = Writers(), {chunk_length: Server(SWEEP_SIZE) for chunk_length in CHUNK_LENGTHS}

    def hold(chunk_length: int | None) -> dict[str, Any]:
        server = servers[chunk_length]
        writers.fill(server, chunk_length, SWEEP_SIZE)
        size = (server.resident() - server.empty_bytes) / SWEEP_SIZE
        return {"kind": "memory", "setting": {"chunk_length": chunk_length}, "bytes_per_transition": round(size)}

    def sample_rate(batch: int, setting: Setting) -> float:
        return sample(servers[setting["chunk_length"]], setting, batch, SWEEP_SECONDS)[0]

    def insert_rate(count: int, setting: Setting) -> float:
        return writers.insert(servers[setting["chunk_length"]], setting, count, SWEEP_SECONDS)[0]

    contests = [sorted(map(hold, CHUNK_LENGTHS), key=lambda row: row["bytes_per_transition"])]
    choices = {"chunk_length": CHUNK_LENGTHS, "in_flight": IN_FLIGHT}
    for batch in (256, 1024):
        contests.append(contest(f"sample {batch}", functools.partial(sample_rate, batch), **choices, workers=WORKERS))
    for count in (1, MOST_WRITERS):
        contests.append(contest(f"insert {count}", functools.partial(insert_rate, count), **choices))
    cpu = next(line for line in Path("/proc/cpuinfo").read_text().splitlines() if line.startswith("model name"))
    return {
        "processor": cpu.split(":")[1].strip(),
        "cores": len(os.sched_getaffinity(0)),
        "load_before_and_after": [load, round(os.getloadavg()[0], 1)],
        "versions": {name: importlib.metadata.version(name) for name in ("dm-reverb", "tensorflow", "numpy")},
        "note": "per_second lists the turns of a setting, whose median counts; those listed with fewer turns fell behind",
        "best": {rows[0]["kind"]: rows[0]["setting"] for rows in contests},
        "measurements": list(itertools.chain(*contests)),
    }


def write_settings(path: str, settings: dict[str, Any]) -> None:
    """A measurement a line."""
    measurements = ",\n".join(f"    {json.dumps(row)}" for row in settings.pop("measurements"))
    head = json.dumps(settings, indent=2).removesuffix("\n}")
    Path(path).write_text(f'{head},\n  "measurements": [\n{measurements}\n  ]\n}}\n')


def main(arguments: list[str]) -> None:
    if arguments[0] == "--sweep":
        write_settings(arguments[1], sweep())
        return
    path, max_size = arguments
    peer = Peer(json.loads(Path(path).read_text())["best"], int(max_size))
    for line in sys.stdin:
        print(json.dumps(peer.answer(json.loads(line))), flush=True)


if __name__ == "__main__":
    main(sys.argv[1:])
