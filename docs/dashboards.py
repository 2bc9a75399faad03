"""Pictures of the dashboards in deploy/grafana/dashboards/, without Grafana: from a Prometheus that scrapes a run.

    cargo xtask dashboards    runs `dashboards.py http://127.0.0.1:9090`: docs/dashboards/{training,fleet,replay}.png

Every panel stands where the dashboard's grid has it, with its own queries, unit, thresholds and legend. A kind of
panel that is not drawn here is said in its place; a panel without an answer is said on standard error too.
"""

import argparse
import copy
import json
import math
import re
import sys
import time
import urllib.error
import urllib.parse
import urllib.request
from dataclasses import dataclass
from datetime import datetime, timezone
from pathlib import Path

import matplotlib
import numpy as np
from PIL import Image  # matplotlib brings it

matplotlib.use("Agg")
from matplotlib import pyplot as plt  # noqa: E402
from matplotlib.font_manager import FontProperties  # noqa: E402
from matplotlib.lines import Line2D  # noqa: E402
from matplotlib.patches import FancyBboxPatch, Rectangle  # noqa: E402
from matplotlib.ticker import FuncFormatter, Locator, LogLocator, MaxNLocator, NullLocator  # noqa: E402

ROOT = Path(__file__).resolve().parent.parent
DASHBOARDS = ROOT / "deploy/grafana/dashboards"

# Pixels: Grafana's grid has 24 columns, and rows of 30 with 8 between.
WIDTH, COLUMNS, ROW, GAP, HEADER = 1600, 24, 38, 8, 44
# A range query asks for no more points than this, and for none closer than Prometheus scrapes, in seconds.
POINTS, SCRAPE = 360, 5
# $__rate_interval, in seconds, unless points are further apart.
RATE_INTERVAL = 30
LEGEND_LINES = 3

BACKGROUND, PANEL, BORDER, GRID, TEXT, DIM = "#111217", "#181b1f", "#2a2d33", "#2c3037", "#d5d6db", "#9a9ea8"
# Grafana's classic palette on dark, and its names of colours.
PALETTE = (
    "#73BF69 #F2CC0C #8AB8FF #FF780A #F2495C #5794F2 #B877D9 #CA95E5 #37872D #FADE2A #C4162A #C0D8FF #FA6400 #96D98D"
).split()
NAMED = {
    "green": "#73BF69",
    "yellow": "#FADE2A",
    "orange": "#FF9830",
    "red": "#F2495C",
    "blue": "#5794F2",
    "purple": "#B877D9",
}
# The same as a ground for white text.
DARK = {
    "green": "#2B6A33",
    "yellow": "#8A7500",
    "orange": "#9C5300",
    "red": "#A3212F",
    "blue": "#1F4F99",
    "purple": "#663A85",
}

STYLE = {
    "font.size": 9,
    "text.color": TEXT,
    "text.parse_math": False,
    "figure.facecolor": BACKGROUND,
    "axes.facecolor": PANEL,
    "axes.edgecolor": BORDER,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.grid": True,
    "axes.axisbelow": True,
    "grid.color": GRID,
    "grid.linewidth": 0.8,
    "xtick.color": DIM,
    "ytick.color": DIM,
    "xtick.labelsize": 8.5,
    "ytick.labelsize": 8.5,
    "xtick.major.size": 0,
    "ytick.major.size": 0,
    "lines.linewidth": 1.4,
    "lines.solid_capstyle": "round",
    "figure.dpi": 100,
    "savefig.dpi": 100,
}


# Prometheus


class Prometheus:
    """Answers to queries over one span of time."""

    def __init__(self, url, minutes):
        self.url = url.rstrip("/")
        self.step = max(SCRAPE, math.ceil(minutes * 60 / POINTS))
        self.end = math.floor(time.time())
        self.start = self.end - round(minutes * 60 / self.step) * self.step
        self.times = np.arange(self.start, self.end + 1, self.step)
        self.rate_interval = max(RATE_INTERVAL, self.step + SCRAPE)
        self.variables = {"__interval": f"{self.step}s", "__rate_interval": f"{self.rate_interval}s"}
        self.variables |= {"actor": ".*", "table": ".*"}

    def ask(self, path, **parameters):
        request = urllib.request.Request(
            f"{self.url}/api/v1/{path}", data=urllib.parse.urlencode(parameters).encode()
        )
        try:
            with urllib.request.urlopen(request, timeout=30) as response:
                return json.load(response)["data"]
        except urllib.error.HTTPError as error:
            sys.exit(f"error: Prometheus refused {parameters}: {error.read().decode(errors='replace')}")
        except (OSError, ValueError, KeyError) as error:
            sys.exit(f"error: no Prometheus answers at {self.url} ({error}): is the cluster up, and the port its?")

    def fill_in(self, query):
        """The query as Grafana sends it; the longest names first, as one may begin with another."""
        for name in sorted(self.variables, key=len, reverse=True):
            query = query.replace(f"${{{name}}}", self.variables[name]).replace(f"${name}", self.variables[name])
        return query

    def range(self, query):
        """Every series as (labels, values at self.times), not a number where there is none."""
        answer = self.ask(
            "query_range", query=self.fill_in(query), start=self.start, end=self.end, step=self.step
        )
        found = []
        for result in answer["result"]:
            values = np.full(len(self.times), np.nan)
            for when, value in result["values"]:
                values[round((float(when) - self.start) / self.step)] = float(value)
            values[np.isinf(values)] = np.nan
            found.append((result["metric"], values))
        return found

    def instant(self, query):
        """Every series as (labels, value) at the end."""
        answer = self.ask("query", query=self.fill_in(query), time=self.end)
        return [(result["metric"], float(result["value"][1])) for result in answer["result"]]

    def run(self, wanted):
        """The run that is wanted, else the only one."""
        seen = {labels["run"] for labels, _ in self.range("group by (run) (getup_build_info)") if "run" in labels}
        if wanted in seen:
            return wanted
        if wanted or len(seen) != 1:
            known = ", ".join(sorted(seen)) or "none"
            sys.exit(f"error: in these minutes Prometheus saw the runs: {known}; choose one with --run")
        return seen.pop()


# Units


def scale_of(unit, largest):
    """(factor, suffix) for an axis or a number of this size."""
    steps = {
        "short": [(1e9, " G"), (1e6, " M"), (1e3, " k"), (1, "")],
        "cps": [(1e6, " M/s"), (1e3, " k/s"), (1, " /s")],
        "s": [(3600, " h"), (60, " min"), (1, " s"), (1e-3, " ms"), (1e-6, " µs")],
        "bytes": [(2**40, " TiB"), (2**30, " GiB"), (2**20, " MiB"), (2**10, " KiB"), (1, " B")],
        "percentunit": [(0.01, " %")],
    }.get(unit, [(1, "")])
    # Minutes from two on, hours likewise: 90 s reads better than 1.5 min.
    least = 2 if unit == "s" else 1
    return next((step for step in steps if largest >= step[0] * (least if step[0] > 1 else 1)), zero_step(steps))


def zero_step(steps):
    """What a number smaller than every step is written in: the last, but 0 is 0 s and not 0 µs."""
    return next((step for step in steps if step[0] == 1), steps[-1])


def written(value, unit, decimals=None):
    factor, suffix = scale_of(unit, abs(value))
    number = value / factor
    if decimals is None:
        decimals = 0 if number == round(number) else 1 if abs(number) >= 10 else 2
    return f"{number:,.{decimals}f}{suffix}".replace("-", "−")


class Ticks(Locator):
    """Round numbers of the axis's own unit: 200 MiB, not 209.7."""

    def __init__(self, factor, count, whole):
        self.factor = factor
        self.inner = MaxNLocator(nbins=count, steps=[1, 2, 2.5, 5, 10], integer=whole)

    def __call__(self):
        return self.tick_values(*self.axis.get_view_interval())

    def tick_values(self, low, high):
        ticks = self.inner.tick_values(low / self.factor, high / self.factor) * self.factor
        slack = (high - low) * 1e-6
        return ticks[(ticks >= low - slack) & (ticks <= high + slack)]


def format_y(axis, config, logarithmic, count):
    """Ticks of an axis whose limits are set."""
    unit = config.get("unit")
    low, high = axis.get_view_interval()
    axis.set_minor_locator(NullLocator())
    if logarithmic:
        narrow = math.log10(high / low) < 2
        axis.set_major_locator(LogLocator(10, subs=(1, 2, 5) if narrow else (1,), numticks=count + 2))
        axis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}".replace("-", "−")))
        return
    factor, suffix = scale_of(unit, max(abs(low), abs(high)))
    locator = Ticks(factor, count, config.get("decimals") == 0)
    ticks = locator.tick_values(low, high) / factor
    space = min(np.diff(ticks), default=1)
    decimals = next((n for n in range(6) if abs(space * 10**n - round(space * 10**n)) < 1e-3), 6)
    axis.set_major_locator(locator)
    zero = "0 %" if unit == "percentunit" else "0"

    def label(value, _):
        text = f"{value / factor:,.{decimals}f}{suffix}".replace("-", "−")
        return zero if abs(value / factor) < space * 1e-3 else text

    axis.set_major_formatter(FuncFormatter(label))


# Panels


@dataclass
class Series:
    name: str
    labels: dict
    values: np.ndarray
    config: dict  # the panel's defaults under its overrides
    colour: str = ""

    @property
    def custom(self):
        return self.config.get("custom", {})

    @property
    def right(self):
        return self.custom.get("axisPlacement") == "right"

    @property
    def label(self):
        return self.name + (" (right)" if self.right else "")

    @property
    def logarithmic(self):
        return self.custom.get("scaleDistribution", {}).get("type") == "log"

    @property
    def last(self):
        known = self.values[~np.isnan(self.values)]
        return known[-1] if len(known) else math.nan


def configured(panel, name):
    """The field configuration of a series: defaults and the overrides that name it."""
    field = panel.get("fieldConfig") or {}
    config = copy.deepcopy(field.get("defaults", {}))
    for override in field.get("overrides", []):
        how, which = override["matcher"]["id"], override["matcher"]["options"]
        if (how == "byName" and which == name) or (how == "byRegexp" and re.search(which.strip("/"), name)):
            for change in override["properties"]:
                *path, last = change["id"].split(".")
                place = config
                for part in path:
                    place = place.setdefault(part, {})
                place[last] = change["value"]
    return config


def series_of(panel, prometheus):
    """The answers to a panel's queries, named by their legends, in the order of the legend."""
    found = []
    for target in panel["targets"]:
        answers = []
        for labels, values in prometheus.range(target["expr"]):
            name = re.sub(r"{{\s*(\w+)\s*}}", lambda match: labels.get(match[1], ""), target.get("legendFormat", ""))
            answers.append(Series(name, labels, values, configured(panel, name)))
        found += sorted(answers, key=lambda series: series.name)
    for index, series in enumerate(found):
        series.colour = PALETTE[index % len(PALETTE)]
    return found


def thresholds(config):
    """(value from which, name of colour), the lowest first; the first has no bound below."""
    steps = config.get("thresholds", {}).get("steps", [])
    return [(-math.inf if step["value"] is None else step["value"], step["color"]) for step in steps]


class Sheet:
    """A figure in pixels from its top left corner."""

    def __init__(self, height):
        self.height = height
        self.figure = plt.figure(figsize=(WIDTH / 100, height / 100))
        self.renderer = self.figure.canvas.get_renderer()

    def at(self, x, y):
        return x / WIDTH, 1 - y / self.height

    def axes(self, x, y, width, height):
        return self.figure.add_axes((x / WIDTH, 1 - (y + height) / self.height, width / WIDTH, height / self.height))

    def text(self, x, y, text, **style):
        return self.figure.text(*self.at(x, y), text, **{"ha": "left", "va": "center", **style})

    def line(self, x, y, length, **style):
        (left, level), (right, _) = self.at(x, y), self.at(x + length, y)
        self.figure.add_artist(Line2D((left, right), (level, level), **style))

    def box(self, x, y, width, height, colour, edge="none"):
        left, bottom = self.at(x, y + height)
        self.figure.add_artist(
            FancyBboxPatch(
                (left, bottom),
                width / WIDTH,
                height / self.height,
                boxstyle="square,pad=0",
                facecolor=colour,
                edgecolor=edge,
                linewidth=1,
                zorder=-1,
            )
        )

    def width_of(self, text, **style):
        properties = FontProperties(size=style.get("fontsize", STYLE["font.size"]), weight=style.get("fontweight"))
        return self.renderer.get_text_width_height_descent(text, properties, False)[0]


def rows(widths, space, available):
    """Indices of things of these widths, broken into rows."""
    broken, used = [[]], 0
    for index, width in enumerate(widths):
        if broken[-1] and used + width > available:
            broken.append([])
            used = 0
        broken[-1].append(index)
        used += width + space
    return broken


@dataclass
class Place:
    """A panel's inside on a sheet, below its title."""

    sheet: Sheet
    x: float
    y: float
    width: float
    height: float

    def say(self, text, **style):
        self.sheet.text(self.x + self.width / 2, self.y + self.height / 2, text, ha="center", color=DIM, **style)


def draw_text(place, panel, _):
    """Markdown's paragraphs, **strong** and *emphasized* words."""
    size, space, y = 10.5, 5, place.y + 6
    for paragraph in panel["options"]["content"].split("\n\n"):
        pieces, spaced = [], False  # (word, whether a space is before it, style)
        for part in re.findall(r"\*\*.+?\*\*|\*.+?\*|`.+?`|[^*`]+", paragraph):
            style = {"fontsize": size}
            if part.startswith("**"):
                style |= {"fontweight": "bold", "color": "white"}
            elif part.startswith("*"):
                style |= {"fontstyle": "italic", "color": "#8AB8FF"}
            elif part.startswith("`"):
                style |= {"color": "#F2CC0C"}
            for space_or_word in re.findall(r"\s+|\S+", part.strip("*`")):
                if space_or_word.isspace():
                    spaced = True
                else:
                    pieces.append((space_or_word, spaced, style))
                    spaced = False
        used = 0
        for token, spaced, style in pieces:
            width = place.sheet.width_of(token, **style)
            if used and used + space + width > place.width - 8:
                used, y = 0, y + 20
            used += space if spaced and used else 0
            place.sheet.text(place.x + used, y, token, **style)
            used += width
        y += 26


def draw_stat(place, panel, prometheus):
    found = [series for series in series_of(panel, prometheus) if not math.isnan(series.last)]
    if not found:
        return False
    height = place.height / len(found)
    for index, series in enumerate(found):
        y, value = place.y + index * height, series.last
        colour = [name for bound, name in thresholds(series.config) if value >= bound][-1]
        mapped = next((m["options"] for m in series.config.get("mappings", []) if m["type"] == "value"), {})
        text = mapped.get(f"{value:g}", {}).get("text") or written(
            value, series.config.get("unit"), series.config.get("decimals")
        )
        place.sheet.box(place.x, y, place.width, height - 4, DARK.get(colour, colour))
        middle = place.x + place.width / 2, y + height / 2
        size = min(34, height * 0.3, place.width / max(len(text), 1) * 0.95)
        place.sheet.text(*middle, text, ha="center", fontsize=size, fontweight="bold", color="white")
        if len(found) > 1 or "{{" in panel["targets"][0].get("legendFormat", ""):
            place.sheet.text(place.x + 8, y + 14, series.name, color="white")
    return True


def draw_table(place, panel, prometheus):
    answers = [answer for target in panel["targets"] for answer in prometheus.instant(target["expr"])]
    if not answers:
        return False
    options = next((t["options"] for t in panel.get("transformations", []) if t["id"] == "organize"), {})
    hidden, order = options.get("excludeByName", {}), options.get("indexByName", {})
    labels = {label for metric, _ in answers for label in metric if not hidden.get(label)}
    columns = sorted(labels | {"Value"}, key=lambda name: (order.get(name, 99), name))
    unit = panel["fieldConfig"]["defaults"].get("unit")
    cells = [[options.get("renameByName", {}).get(name, name) for name in columns]]
    for metric, value in sorted(answers, key=lambda answer: [answer[0].get(name, "") for name in columns]):
        cells.append([written(value, unit) if name == "Value" else metric.get(name, "") for name in columns])
    for row, values in enumerate(cells):
        y = place.y + 12 + row * 27
        for column, value in enumerate(values):
            style = {"color": "#8AB8FF", "fontweight": "bold"} if row == 0 else {"color": TEXT}
            place.sheet.text(place.x + 6 + column * place.width / len(columns), y, value, fontsize=10, **style)
        place.sheet.line(place.x, y + 13.5, place.width, color=GRID, linewidth=1)
    return True


def format_time(axes, prometheus):
    axes.set_xlim(*(np.array([prometheus.start, prometheus.end]).astype("datetime64[s]")))
    width = axes.get_position().width * WIDTH
    span = prometheus.end - prometheus.start
    # Whole minutes, with room for every label.
    space = next((m for m in (1, 2, 5, 10, 15, 30, 60, 120, 240, 480) if width * m * 60 / span >= 58), 1440) * 60
    ticks = np.arange(math.ceil(prometheus.start / space) * space, prometheus.end + 1, space)
    axes.set_xticks(ticks.astype("datetime64[s]"), [f"{datetime.fromtimestamp(t, timezone.utc):%H:%M}" for t in ticks])


def draw_heatmap(place, panel, prometheus):
    """Buckets of a Prometheus histogram, which count what is under them too, as counts of their own."""
    found = [series for series in series_of(panel, prometheus) if "le" in series.labels]
    found.sort(key=lambda series: float(series.labels["le"]))
    if not found:
        return False
    counts = np.diff([np.zeros(len(prometheus.times)), *(series.values for series in found)], axis=0)
    counts = np.ma.masked_where(~(counts > 1e-9), counts)
    axes = place.sheet.axes(place.x + 40, place.y + 6, place.width - 52, place.height - 62)
    half = prometheus.step / 2
    edges = np.append(prometheus.times - half, prometheus.times[-1] + half).astype("datetime64[s]")
    norm = matplotlib.colors.PowerNorm(0.5, vmin=0, vmax=max(1, counts.max() if counts.count() else 1))
    mesh = axes.pcolormesh(edges, np.arange(len(found) + 1), counts, cmap="Spectral_r", norm=norm)
    every = math.ceil(len(found) * 14 / (place.height - 62))
    ticks = [index for index in range(len(found)) if (len(found) - 1 - index) % every == 0]
    axes.set_yticks([index + 1 for index in ticks], [found[i].labels["le"].replace("+Inf", "∞") for i in ticks])
    format_time(axes, prometheus)
    bar = place.sheet.axes(place.x + 40, place.y + place.height - 22, 150, 8)
    place.sheet.figure.colorbar(mesh, cax=bar, orientation="horizontal", ticks=[])
    bar.grid(False)
    place.sheet.text(place.x + 34, place.y + place.height - 18, "0", ha="right", color=DIM, fontsize=8.5)
    most = written(round(norm.vmax), panel["options"].get("cellValues", {}).get("unit"))
    most += f" in {prometheus.rate_interval} s"
    place.sheet.text(place.x + 196, place.y + place.height - 18, most, color=DIM, fontsize=8.5)
    return True


def draw_legend(place, found):
    """Names under a panel, those of series that are 0 throughout last; gives the height they take."""
    idle = [series for series in found if not np.any(np.nan_to_num(series.values))]
    shown = [series for series in found if series not in idle] + idle
    size, mark, space = 8.5, 16, 14
    widths = [mark + place.sheet.width_of(series.label, fontsize=size) for series in shown]
    while True:
        left_out = len(found) - len(shown)
        more = f"and {left_out} more" + (", all 0" if left_out <= len(idle) else "")
        extra = [place.sheet.width_of(more, fontsize=size)] if left_out else []
        broken = rows(widths[: len(shown)] + extra, space, place.width - 16)
        if len(broken) <= LEGEND_LINES or not shown:
            break
        shown.pop()
    top = place.y + place.height - 16 * len(broken)
    for line, indices in enumerate(broken):
        x, y = place.x + 8, top + 16 * line + 6
        for index in indices:
            if index < len(shown):
                series = shown[index]
                place.sheet.line(x, y, 11, color=series.colour, linewidth=2.4, linestyle=line_style(series, 3))
                place.sheet.text(x + mark, y, series.label, fontsize=size)
                x += widths[index] + space
            else:
                place.sheet.text(x, y, more, fontsize=size, color=DIM)
    return 16 * len(broken)


def line_style(series, dash=6):
    return (0, (dash, dash * 0.7)) if series.custom.get("lineStyle", {}).get("fill") == "dash" else "solid"


def set_limits(axes, found, tops):
    """The y axis: the panel's own limits, else what is drawn with some room."""
    config, custom = found[0].config, found[0].custom
    drawn = np.concatenate([*tops, *(series.values for series in found)])
    drawn = drawn[~np.isnan(drawn)]
    if found[0].logarithmic:
        axes.set_yscale("log")
        drawn = drawn[drawn > 0]
        low, high = (min(drawn), max(drawn)) if len(drawn) else (0.1, 10)
        axes.set_ylim(low / 1.3, max(high, low * 3) * 1.3)
        return
    low, high = min(drawn), max(drawn)
    low, high = min(low, custom.get("axisSoftMin", low)), max(high, custom.get("axisSoftMax", high))
    low, high = config.get("min", low), config.get("max", high)
    room = (high - low) * 0.06 or abs(high) * 0.1 or 1
    axes.set_ylim(low if "min" in config else low - room, high if "max" in config else high + room)


def draw_timeseries(place, panel, prometheus, promotions):
    found = series_of(panel, prometheus)
    found = [series for series in found if not np.all(np.isnan(series.values))]
    if not found:
        return False
    legend = draw_legend(place, found)
    right = [series for series in found if series.right]
    left = [series for series in found if not series.right]
    box = place.x + 60, place.y + 6, place.width - (60 if not right else 108) - 12, place.height - legend - 38
    axes = place.sheet.axes(*box)
    times = prometheus.times.astype("datetime64[s]")
    sides = [(axes, left)] if left else []
    if right:
        sides.append((axes.twinx(), right))
    for side, members in sides:
        stack, tops = np.zeros(len(times)), [np.array([])]
        for series in members:
            values, custom = series.values, series.custom
            style = {"color": series.colour, "linestyle": line_style(series)}
            if custom.get("stacking", {}).get("mode") == "normal":
                below, stack = stack, stack + np.nan_to_num(values)
                values = np.where(np.isnan(values), np.nan, stack)
                tops.append(values)
                side.fill_between(times, below, values, color=series.colour, alpha=0.3, linewidth=0)
            if custom.get("drawStyle") == "points":
                side.plot(times, values, color=series.colour, linestyle="none", marker="o", markersize=3)
            elif custom.get("lineInterpolation") == "stepAfter":
                side.plot(times, values, drawstyle="steps-post", **style)
            else:
                side.plot(times, values, **style)
                # A point between two gaps has no line to be seen by.
                known = np.pad(~np.isnan(values), 1)
                alone = known[1:-1] & ~known[:-2] & ~known[2:]
                side.plot(times[alone], values[alone], color=series.colour, linestyle="none", marker="o", markersize=3)
        set_limits(side, members, tops)
        format_y(side.yaxis, members[0].config, members[0].logarithmic, max(3, int(box[3] / 38)))
        side.tick_params(pad=5)
        if side is not axes:
            side.grid(False)
    if panel["fieldConfig"]["defaults"]["custom"].get("thresholdsStyle", {}).get("mode") == "dashed":
        low, high = axes.get_ylim()
        for bound, colour in thresholds(panel["fieldConfig"]["defaults"]):
            if low <= bound <= high:
                axes.axhline(bound, color=NAMED.get(colour, colour), linestyle=(0, (6, 4)), linewidth=1.2)
    for when in promotions:
        axes.axvline(np.datetime64(int(when), "s"), color=NAMED["purple"], linestyle=(0, (2, 2)), linewidth=1.2)
    format_time(axes, prometheus)
    return True


# Dashboards


def events(dashboard, prometheus):
    """When the dashboard's annotations begin: the first of points that follow each other."""
    begun = []
    for annotation in dashboard.get("annotations", {}).get("list", []):
        if annotation.get("enable") and "expr" in annotation:
            for _, values in prometheus.range(annotation["expr"]):
                known = np.pad(~np.isnan(values), (1, 0))
                begun += list(prometheus.times[known[1:] & ~known[:-1]])
    return begun


def draw(dashboard, prometheus, path):
    panels = dashboard["panels"]
    bottom = max(panel["gridPos"]["y"] + panel["gridPos"]["h"] for panel in panels)
    sheet = Sheet(HEADER + bottom * ROW + GAP)
    column = (WIDTH - GAP) / COLUMNS
    sheet.text(GAP + 4, HEADER / 2, dashboard["title"], fontsize=15, fontweight="bold", color="white")
    until = datetime.fromtimestamp(prometheus.end, timezone.utc)
    span = f"{(prometheus.end - prometheus.start) / 60:g} minutes until {until:%Y-%m-%d %H:%M} UTC"
    run = f"run {prometheus.variables['run']}, {span}"
    sheet.text(WIDTH - GAP - 4, HEADER / 2, run, ha="right", fontsize=11, color=DIM)
    begun = events(dashboard, prometheus)
    kinds = {
        "text": draw_text,
        "stat": draw_stat,
        "table": draw_table,
        "heatmap": draw_heatmap,
        "timeseries": lambda *args: draw_timeseries(*args, begun),
    }
    for panel in panels:
        grid = panel["gridPos"]
        x, y = GAP + grid["x"] * column, HEADER + grid["y"] * ROW
        width, height = grid["w"] * column - GAP, grid["h"] * ROW - GAP
        sheet.box(x, y, width, height, PANEL, BORDER)
        sheet.text(x + 10, y + 17, panel["title"], fontsize=10.5, fontweight="bold")
        place = Place(sheet, x + 8, y + 34, width - 16, height - 40)
        if panel["type"] not in kinds:
            place.say(f"not drawn: a panel of kind {panel['type']}")
        elif kinds[panel["type"]](place, panel, prometheus) is False:
            place.say("No data", fontsize=12)
            print(f"{path.name}: no data for {panel['title']}", file=sys.stderr)
    sheet.figure.canvas.draw()
    pixels = np.asarray(sheet.figure.canvas.buffer_rgba())[:, :, :3]
    # A third of the size: few colours, and those smoothed at edges, are many pixels.
    few = Image.fromarray(pixels).quantize(256, Image.Quantize.MAXCOVERAGE, dither=Image.Dither.NONE)
    few.save(path, optimize=True)
    plt.close(sheet.figure)


def main():
    parser = argparse.ArgumentParser(description="Pictures of the dashboards from a Prometheus, without Grafana.")
    parser.add_argument("url", metavar="PROMETHEUS_URL", help="such as http://127.0.0.1:9090")
    parser.add_argument("--run", help="the run to show; needed where Prometheus has seen several")
    parser.add_argument("--minutes", type=float, default=15, help="how far back from now (default: 15)")
    parser.add_argument("--output", type=Path, default=ROOT / "docs/dashboards", help="default: docs/dashboards")
    args = parser.parse_args()
    if not args.minutes >= 1:
        parser.error("--minutes is to be 1 or more")
    prometheus = Prometheus(args.url, args.minutes)
    prometheus.variables["run"] = prometheus.run(args.run)
    args.output.mkdir(parents=True, exist_ok=True)
    for source in sorted(DASHBOARDS.glob("*.json")):
        dashboard = json.loads(source.read_text(encoding="utf-8"))
        path = args.output / f"{source.stem}.png"
        with plt.rc_context(STYLE):
            draw(dashboard, prometheus, path)
        print(f"{path.name}: {len(dashboard['panels'])} panels, {path.stat().st_size / 1000:.0f} kB")


if __name__ == "__main__":
    main()
