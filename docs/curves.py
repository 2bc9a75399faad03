"""The figures of docs/ and the table of the runs, from what runs leave in docs/runs/.

    cargo xtask plot    runs `curves.py plot`: learning-curve.png, torque-limit.png, standing.png, ablation.png,
                        fleet.png
    cargo xtask runs    runs `curves.py table`: a Markdown table on standard output

A run is a folder NAME-SEED with three files that `getup train` wrote: config.toml, evaluations.jsonl, timings.jsonl.
fleet.json is no run: `cargo xtask bench fleet` wrote it, with GETUP_FLEET_RECORD=1.
What is left out, and why, is said on standard error.
"""

import json
import re
import sys
from dataclasses import dataclass
from pathlib import Path

import matplotlib
import numpy as np

matplotlib.use("Agg")
from matplotlib import pyplot as plt  # noqa: E402
from matplotlib.ticker import EngFormatter, PercentFormatter  # noqa: E402

try:
    import tomllib
except ModuleNotFoundError:  # Python 3.10
    import tomli as tomllib

DOCS = Path(__file__).resolve().parent
RUNS = DOCS / "runs"
FILES = ("config.toml", "evaluations.jsonl", "timings.jsonl")
FLEET = RUNS / "fleet.json"

# The return over which every fall must come for β to go down, §5 of the paper.
OMEGA = 60.0
ENV_STEPS, MINUTES = "env steps", "wall time (minutes)"

# One run's line is a shade of its family's colour; the families differ in lightness too.
FAMILIES = ("Blues", "Oranges", "Greens", "Purples", "Greys")
# The ablation's kinds: label and colour, of Okabe and Ito's colour-blind-safe set.
ABLATION = {
    "curriculum": ("strong-to-weak curriculum", "#0072B2"),
    "fixed-100": ("fixed at 100 %", "#E69F00"),
    "fixed-60": ("fixed at 60 %", "#009E73"),
    "fixed-50": ("fixed at 50 %", "#CC79A7"),
    "fixed-40": ("fixed at 40 %", "#555555"),
}

# The fleet's processes, of the same set.
ROLES = {"replay": "#0072B2", "learner": "#E69F00", "load": "#555555"}

STYLE = {
    "font.size": 10,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.edgecolor": "#666666",
    "axes.grid": True,
    "axes.axisbelow": True,
    "grid.color": "#e8e8e8",
    "xtick.color": "#444444",
    "ytick.color": "#444444",
    "lines.linewidth": 1.6,
    "lines.solid_capstyle": "round",
    "legend.framealpha": 0.85,
    "legend.edgecolor": "none",
    "legend.fontsize": 9,
    "figure.constrained_layout.use": True,
    "figure.constrained_layout.w_pad": 0.08,
    "savefig.dpi": 150,
}


# Runs


@dataclass(frozen=True)
class Evaluation:
    """One line of evaluations.jsonl, with the minutes of training behind it."""

    env_steps: int
    minutes: float
    beta: float
    mean: float
    min: float
    stands: float | None  # older runs did not count


@dataclass(frozen=True)
class Run:
    name: str
    seed: int
    omega: float
    evaluations: list[Evaluation]

    @property
    def family(self):
        """The name without its seed."""
        return re.sub(r"-\d+$", "", self.name)

    @property
    def label(self):
        """The name, which mostly ends with the seed, as in the table."""
        named = self.family == "standing" or self.name.endswith(f"-{self.seed}")
        return self.name if named else f"{self.name}, seed {self.seed}"

    def column(self, field):
        """One field of every evaluation."""
        return [getattr(evaluation, field) for evaluation in self.evaluations]

    def against(self, axis):
        """The x coordinates of the evaluations on ENV_STEPS or MINUTES."""
        return self.column("env_steps" if axis == ENV_STEPS else "minutes")


def leave_out(what, why):
    print(f"{what} left out: {why}", file=sys.stderr)


def read_runs(folder):
    """The runs in a folder, by family and seed."""
    runs = []
    for path in folder.iterdir() if folder.is_dir() else ():
        missing = [name for name in FILES if not (path / name).is_file()]
        if len(missing) == len(FILES):
            continue  # no run: a file, or a folder of runs
        if missing:
            leave_out(path.relative_to(DOCS.parent), f"it has no {' and no '.join(missing)}")
            continue
        run = read_run(path)
        if run.evaluations:
            runs.append(run)
        else:
            leave_out(path.relative_to(DOCS.parent), "it has no evaluation yet")
    return sorted(runs, key=lambda run: (run.family, run.seed, run.name))


def read_run(folder):
    """A run with one clock: every process that resumed it counted its seconds from 0."""
    try:
        config = tomllib.loads((folder / "config.toml").read_text(encoding="utf-8"))
        seconds = {line["version"]: line["seconds"] for line in read_lines(folder / "timings.jsonl")}
        evaluations, process, before, now = [], None, 0.0, 0.0
        for line in read_lines(folder / "evaluations.jsonl"):
            if line["version"] not in seconds:
                continue  # killed between the two files
            incarnation = line["version"].split(".")[0]
            if incarnation != process:
                process, before = incarnation, now
                # A killed run resumes from its last checkpoint, and evaluates again what came after.
                while evaluations and evaluations[-1].env_steps >= line["env_steps"]:
                    evaluations.pop()
            now = before + seconds[line["version"]]
            fields = (line[field] for field in ("beta", "mean", "min"))
            evaluations.append(Evaluation(line["env_steps"], now / 60, *fields, line.get("stands")))
        return Run(folder.name, config["seed"], config["curriculum"]["omega"], evaluations)
    except KeyError as error:
        sys.exit(f"error: {folder} has no {error}: is it the folder of a run, whole, by this getup?")
    except tomllib.TOMLDecodeError as error:
        sys.exit(f"error: {folder / 'config.toml'} is not TOML ({error}): copy it anew from the run")


def read_lines(path):
    for number, line in enumerate(path.read_text(encoding="utf-8").splitlines(), 1):
        try:
            yield json.loads(line)
        except json.JSONDecodeError as error:
            sys.exit(f"error: {path}, line {number} is not JSON ({error}): copy the file anew from the run")


def read_fleet():
    """The points of the fleet, in the order of their numbers of actors; none where it was not measured."""
    if not FLEET.is_file():
        return []
    try:
        fleet = json.loads(FLEET.read_text(encoding="utf-8"))
        # The further point, with fewer broadcasts, is docs/scale.md's.
        usual = fleet["broadcasts_per_second"]
        points = [point for point in fleet["points"] if point["broadcasts"] == usual]
        return sorted(points, key=lambda point: point["actors"])
    except (KeyError, json.JSONDecodeError) as error:
        sys.exit(f"error: {FLEET} is not what this version of `cargo xtask bench fleet` writes ({error!r})")


# Figures


def shades(runs):
    """A colour for every run: its family's, darker from seed to seed."""
    families = sorted({run.family for run in runs})
    colours = {}
    for index, family in enumerate(families):
        names = [run.name for run in runs if run.family == family]
        colormap = matplotlib.colormaps[FAMILIES[index % len(FAMILIES)]]
        depths = np.linspace(0.4, 1.0, len(names)) if len(names) > 1 else [0.8]
        colours.update(zip(names, map(colormap, depths)))
    return colours


def label_x(axes, axis):
    axes.set_xlabel(axis)
    axes.set_xlim(left=0)
    if axis == ENV_STEPS:
        axes.xaxis.set_major_formatter(EngFormatter(sep=" "))


def draw_omega(axes):
    axes.axhline(OMEGA, color="#333333", linestyle=(0, (5, 3)), linewidth=1.1, label=f"ω = {OMEGA:g}")


def over_steps_and_minutes(y_label):
    """Two panels with one y axis: (panel, what its x axis is)."""
    figure, panels = plt.subplots(1, 2, sharey=True, figsize=(10.5, 4))
    panels[0].set_ylabel(y_label)
    return figure, tuple(zip(panels, (ENV_STEPS, MINUTES)))


def say_which_is_which(figure, axes):
    """One legend for panels with the same lines, beside them: there are too many runs for a place among the lines."""
    figure.legend(*axes.get_legend_handles_labels(), loc="outside right center")


def learning_curve(runs):
    """The mean return of every evaluation, as Fig. 3a."""
    figure, panels = over_steps_and_minutes("mean return of an evaluation")
    colours = shades(runs)
    for axes, axis in panels:
        for run in runs:
            axes.plot(run.against(axis), run.column("mean"), color=colours[run.name], label=run.label)
        draw_omega(axes)
        label_x(axes, axis)
        axes.set_ylim(bottom=0)
    say_which_is_which(figure, panels[1][0])
    return figure


def torque_limit(runs):
    """β of every evaluation, as Fig. 3b."""
    figure, panels = over_steps_and_minutes("torque limit β")
    colours = shades(runs)
    for axes, axis in panels:
        for run in runs:
            # An evaluation that passes lowers β at once: the next one's β holds from there.
            style = {"drawstyle": "steps-pre", "color": colours[run.name], "label": run.label}
            axes.plot(run.against(axis), run.column("beta"), **style)
        axes.axhline(1, color="#333333", linestyle=(0, (1, 2)), linewidth=1.1, label="the character’s own")
        label_x(axes, axis)
    say_which_is_which(figure, panels[1][0])
    return figure


def standing(runs):
    """How a policy that gets up learns to stay standing: share of falls, and return, over minutes."""
    figure, (rates, returns) = plt.subplots(1, 2, figsize=(9, 3.5))
    colours = shades(runs)
    for run in runs:
        style = {"color": colours[run.name], "label": run.label}
        rates.plot(run.column("minutes"), run.column("stands"), **style)
        returns.plot(run.column("minutes"), run.column("mean"), **style)
    rates.set_ylabel("falls that end standing")
    rates.yaxis.set_major_formatter(PercentFormatter(xmax=1, decimals=0, symbol=" %"))
    rates.set_ylim(-0.02, 1.02)
    returns.set_ylabel("mean return of an evaluation")
    returns.set_ylim(bottom=0)
    for axes in (rates, returns):
        label_x(axes, MINUTES)
    if len(runs) > 1:
        rates.legend(loc="lower right")
    return figure


def ablation(runs):
    """The curriculum against fixed torque limits, as Fig. 3a: the mean of the seeds, and each seed thinly."""
    figure, axes = plt.subplots(figsize=(9, 3.8))
    for family, (label, colour) in ABLATION.items():
        seeds = [run for run in runs if run.family == family]
        if not seeds:
            leave_out(f"{label} in ablation.png", f"no run {family}-SEED in docs/runs/ablation/")
            continue
        curves = [(run.column("env_steps"), run.column("mean")) for run in seeds]
        for steps, returns in curves:
            axes.plot(steps, returns, color=colour, linewidth=0.7, alpha=0.45)
        # As far as all seeds went.
        grid = np.linspace(0, min(steps[-1] for steps, _ in curves), 200)
        mean = np.mean([np.interp(grid, steps, returns) for steps, returns in curves], axis=0)
        width = 2.4 if family == "curriculum" else 1.6
        axes.plot(grid, mean, color=colour, linewidth=width, label=label)
    draw_omega(axes)
    label_x(axes, ENV_STEPS)
    axes.set_ylabel("mean return of an evaluation")
    axes.set_ylim(bottom=0)
    figure.legend(loc="outside right center")
    return figure


def fleet(points):
    """Latencies, and the processor time of each process, over the number of simulated actors."""
    figure, (lag, append, cpu) = plt.subplots(1, 3, figsize=(9, 3.2))
    actors = [point["actors"] for point in points]
    dots = {"marker": "o", "markersize": 3}

    def column(name, scale=1.0):
        return [scale * point[name] for point in points]

    for axes, name, label in ((lag, "lag", "broadcast lag (ms)"), (append, "append", "append (ms)")):
        for share, style in (("99", "-"), ("50", (0, (4, 2)))):
            values = column(f"{name}_p{share}", 1000)
            axes.plot(actors, values, color="#0072B2", linestyle=style, label=f"p{share}", **dots)
        axes.set_yscale("log")
        axes.yaxis.set_major_formatter("{x:g}")
        axes.set_ylabel(label)
        axes.legend(loc="upper left")
    for role, colour in ROLES.items():
        cpu.plot(actors, column(f"cpu_{role}"), color=colour, label=role, **dots)
    cpu.set_ylabel("processor time (s/s)")
    cpu.set_ylim(bottom=0)
    cpu.legend(loc="upper left")
    for axes in (lag, append, cpu):
        axes.set_xscale("log", base=2)
        axes.set_xticks(actors, [f"{number}" for number in actors])
        axes.set_xlabel("actors")
    return figure


def save(name, figure):
    figure.savefig(DOCS / name)
    plt.close(figure)


def plot(runs, ablated, points):
    """Draws every figure that there are runs for."""
    learners = [run for run in runs if run.family != "standing"]
    standers = [run for run in runs if run.family == "standing" and None not in run.column("stands")]
    figures = (
        ("learning-curve.png", learning_curve, learners, "no run in docs/runs/, such as docs/runs/laptop-1/"),
        ("torque-limit.png", torque_limit, learners, "no run in docs/runs/, such as docs/runs/laptop-1/"),
        ("standing.png", standing, standers, "no run docs/runs/standing/ that counts who stands"),
        ("ablation.png", ablation, ablated, "no run in docs/runs/ablation/; cargo xtask ablate trains them"),
    )
    for name, draw, of, why in figures:
        if not of:
            leave_out(f"docs/{name}", why)
            continue
        with plt.rc_context(STYLE):
            save(name, draw(of))
        print(f"docs/{name}: {', '.join(run.name for run in of)}")
    if points:
        with plt.rc_context(STYLE):
            save("fleet.png", fleet(points))
        print(f"docs/fleet.png: {len(points)} numbers of actors")
    else:
        leave_out("docs/fleet.png", "no docs/runs/fleet.json, of cargo xtask bench fleet")


# Table


def cost(evaluation):
    """What it took to get to an evaluation; a dash where there is none."""
    if evaluation is None:
        return "–"
    return f"{evaluation.env_steps / 1000:,.0f} k / {evaluation.minutes:.1f} min"


def table(runs):
    """What each run took to reach each mark, as Markdown."""
    marks = {
        "mean return 10": lambda found: found.mean >= 10,
        "mean return 30": lambda found: found.mean >= 30,
        f"minimum over {OMEGA:g} at β = 1": lambda found: found.min > OMEGA and abs(found.beta - 1) < 1e-9,
        f"minimum over {OMEGA:g} at β ≤ 0.6": lambda found: found.min > OMEGA and found.beta <= 0.6 + 1e-3,
    }
    rows = [["run", "seed", *marks, "lowest β passed", "in all"], ["---"] + ["---:"] * (len(marks) + 3)]
    for run in runs:
        costs = [cost(next(filter(reached, run.evaluations), None)) for reached in marks.values()]
        passed = [found.beta for found in run.evaluations if found.min > run.omega]
        weakest = f"{min(passed):.2f}" if passed else "–"
        rows.append([run.name, str(run.seed), *costs, weakest, cost(run.evaluations[-1])])
    for row in rows:
        print(f"| {' | '.join(row)} |")


def main():
    mode = sys.argv[1:]
    if mode not in (["plot"], ["table"]):
        sys.exit("usage: curves.py plot | table    (or: cargo xtask plot, cargo xtask runs)")
    runs = read_runs(RUNS)
    ablated = read_runs(RUNS / "ablation") if mode == ["plot"] else []
    if not runs and not ablated:
        files = ", ".join(FILES)
        sys.exit(f"error: no run in {RUNS}: copy {files} of a run to docs/runs/NAME-SEED/, such as laptop-1/")
    if mode == ["plot"]:
        plot(runs, ablated, read_fleet())
    else:
        table([run for run in runs if run.family != "standing"])


if __name__ == "__main__":
    main()
