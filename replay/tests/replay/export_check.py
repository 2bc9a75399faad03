#!/usr/bin/env python3
"""Reads an export of a replay store as its users do, and compares it with what should be in it.

    export_check.py npz|minari PATH FACTS.json

npz needs `numpy`; minari needs `minari[arrow]` and `pillow`. FACTS.json:

    {"transitions": 120, "episodes": 7,
     "columns": {"observation": {"width": 3, "rows": "steps_plus_one"}, ...},
     "samples": [{"episode": 2, "at": 5, "step": 13, "writer": 9, "lane": 1, "stage": 0,
                  "terminal": false, "truncated": false, "cut": false,
                  "values": {"observation": [...], ...}, "next": {"observation": [...]}}, ...]}

`rows` is `steps`, `steps_plus_one` or `once`. A sample is a transition: `episode` counts the exported episodes, `at` the
steps of it that are there, `step` those that there were; `cut` marks the last one of an episode without an end.

Ends with 0 if all is as it should be, 1 with the first difference, 77 where a package is missing.
"""

import json
import os
import pathlib
import sys
import warnings

MISSING_PACKAGE = 77

try:
    import numpy as np
except ImportError as error:
    print(f"skipped: {error}")
    sys.exit(MISSING_PACKAGE)


def check(holds, message):
    if not holds:
        print(f"export_check: {message}")
        sys.exit(1)


def check_equal(what, found, expected):
    check(np.array_equal(found, expected), f"{what} is {found} and should be {expected}")


def f32(values):
    return np.asarray(values, dtype=np.float32)


def check_npz(path, facts):
    archive = np.load(path, allow_pickle=False)
    arrays = {name: archive[name] for name in archive.files}
    n = facts["transitions"]
    shapes = {
        "terminal": ((n,), np.bool_),
        "truncated": ((n,), np.bool_),
        "episode": ((n,), np.int64),
        "step": ((n,), np.int64),
        "writer": ((n,), np.uint64),
        "lane": ((n,), np.uint32),
        "stage": ((n,), np.uint32),
    }
    for name, column in facts["columns"].items():
        shapes[name] = ((n, column["width"]), np.float32)
        if column["rows"] == "steps_plus_one":
            shapes[f"next_{name}"] = shapes[name]
    check_equal("the set of arrays", sorted(arrays), sorted(shapes))
    for name, (shape, dtype) in shapes.items():
        check_equal(f"the shape of {name}", arrays[name].shape, shape)
        check(arrays[name].dtype == dtype, f"{name} is {arrays[name].dtype} and should be {dtype}")
    starts = check_npz_episodes(arrays, facts)
    for sample in facts["samples"]:
        check_npz_sample(arrays, starts[sample["episode"]] + sample["at"], sample)


def check_npz_episodes(arrays, facts):
    """Each episode stands in one piece, and only its last row ends it. Returns where each begins."""
    episode, step = arrays["episode"], arrays["step"]
    starts = np.flatnonzero(np.diff(episode, prepend=-1))
    check_equal("the order of the episodes", episode[starts], np.arange(facts["episodes"]))
    inside = np.diff(episode) == 0
    check(np.all(np.diff(step)[inside] == 1), "the steps of an episode do not follow one another")
    ends = arrays["terminal"] | arrays["truncated"]
    check(not np.any(ends[:-1] & inside), "an episode ends before its last row")
    check(not np.any(arrays["terminal"] & arrays["truncated"]), "a row is both terminal and truncated")
    for name in ["writer", "lane"]:
        check(np.all(np.diff(arrays[name].astype(object))[inside] == 0), f"an episode has more than one {name}")
    for name, column in facts["columns"].items():
        if column["rows"] == "steps_plus_one":
            joined = arrays[f"next_{name}"][:-1][inside], arrays[name][1:][inside]
            check(np.array_equal(*joined), f"the next {name} is not that of the next row")
    return starts


def check_npz_sample(arrays, row, sample):
    for name, values in sample["values"].items():
        check_equal(f"{name}[{row}]", arrays[name][row], f32(values))
    for name, values in sample["next"].items():
        check_equal(f"next_{name}[{row}]", arrays[f"next_{name}"][row], f32(values))
    for name in ["episode", "step", "writer", "lane", "stage", "terminal", "truncated"]:
        found = arrays[name][row].item()
        check(found == sample[name], f"{name}[{row}] is {found} and should be {sample[name]}")


def check_minari(path, facts):
    try:
        import minari
        import PIL  # noqa: F401  (minari's Arrow reader imports it)
        import pyarrow  # noqa: F401
    except ImportError as error:
        print(f"skipped: {error}")
        sys.exit(MISSING_PACKAGE)
    dataset = minari.MinariDataset(path / "data")
    check_equal("total_steps", dataset.total_steps, facts["transitions"])
    check_equal("total_episodes", dataset.total_episodes, facts["episodes"])
    for name, space in [("observation", dataset.observation_space), ("action", dataset.action_space)]:
        check_equal(f"the shape of the {name} space", space.shape, (facts["columns"][name]["width"],))
        check(space.dtype == np.float32, f"the {name} space is of {space.dtype}")
    episodes = list(dataset.iterate_episodes())
    check_equal("the ids of the episodes", [episode.id for episode in episodes], np.arange(facts["episodes"]))
    check_equal("the sum of the episodes' steps", sum(map(len, episodes)), facts["transitions"])
    for episode in episodes:
        check_minari_episode(dataset, episode, facts["columns"])
    metadata = list(dataset.storage.get_episode_metadata(range(dataset.total_episodes)))
    for sample in facts["samples"]:
        which = sample["episode"]
        check_minari_sample(episodes[which], metadata[which], sample)
    check_minari_finds(minari, path, dataset)


def check_minari_episode(dataset, episode, columns):
    which, steps = f"episode {episode.id}", len(episode)
    for name, array, space, rows in [
        ("observations", episode.observations, dataset.observation_space, steps + 1),
        ("actions", episode.actions, dataset.action_space, steps),
    ]:
        check_equal(f"the shape of {name} in {which}", array.shape, (rows, *space.shape))
        check(array.dtype == np.float32, f"{name} in {which} are of {array.dtype}")
        check(all(space.contains(row) for row in array), f"{name} in {which} leave their space")
    check(episode.rewards.dtype == np.float32, f"rewards in {which} are of {episode.rewards.dtype}")
    ends = episode.terminations | episode.truncations
    check_equal(f"the ends in {which}", np.flatnonzero(ends), [steps - 1])
    check(not np.any(episode.terminations & episode.truncations), f"{which} ends in two ways")
    others = columns.keys() - {"observation", "action", "reward"}
    check_equal(f"the infos in {which}", sorted(episode.infos), sorted(others))
    for name in others:
        info = episode.infos[name]
        check_equal(f"the shape of info {name} in {which}", info.shape, (steps + 1, columns[name]["width"]))
        check(info.dtype == np.float32, f"info {name} in {which} is of {info.dtype}")
        if columns[name]["rows"] == "steps":
            check(not np.any(info[-1]), f"info {name} in {which} does not end with zeros")


def check_minari_sample(episode, metadata, sample):
    at = sample["at"]
    where = f"episode {episode.id}, row {at}"
    arrays = {"observation": episode.observations, "action": episode.actions, **episode.infos}
    arrays["reward"] = episode.rewards.reshape(-1, 1)
    for name, values in sample["values"].items():
        check_equal(f"{name} in {where}", arrays[name][at], f32(values))
    for name, values in sample["next"].items():
        check_equal(f"{name} after {where}", arrays[name][at + 1], f32(values))
    check_equal(f"termination in {where}", episode.terminations[at], sample["terminal"])
    check_equal(f"truncation in {where}", episode.truncations[at], sample["truncated"] or sample["cut"])
    for name in ["writer", "lane", "stage"]:
        check(metadata[name] == sample[name], f"{name} of {where} is {metadata[name]}")
    check_equal(f"step in {where}", metadata["first_step"] + at, sample["step"])
    last = at + 1 == len(episode)
    check(not last or metadata["finished"] != sample["cut"], f"{where}: finished is {metadata['finished']}")


def check_minari_finds(minari, path, dataset):
    """The dataset is found by its name, and listed without complaint."""
    root = path.resolve()
    for _ in pathlib.PurePosixPath(dataset.id).parts:
        root = root.parent
    os.environ["MINARI_DATASETS_PATH"] = str(root)
    loaded = minari.load_dataset(dataset.id)
    check_equal("the steps of the dataset by its name", loaded.total_steps, dataset.total_steps)
    check(len(loaded[0]) > 0, "an episode by its index is empty")
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        listed = minari.list_local_datasets()
    check(dataset.id in listed, f"{dataset.id} is not listed under {root}")


def main():
    kind, path, facts = sys.argv[1], pathlib.Path(sys.argv[2]), json.loads(pathlib.Path(sys.argv[3]).read_text())
    {"npz": check_npz, "minari": check_minari}[kind](path, facts)
    print(f"{path}: {facts['transitions']} transitions and {len(facts['samples'])} samples are as they should be")


if __name__ == "__main__":
    main()
