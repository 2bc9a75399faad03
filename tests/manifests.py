#!/usr/bin/env python3
"""Checks what deploy/ holds against the schemas that its readers publish.

    manifests.py dashboards FILE...    Grafana's dashboards: every field is one that Grafana's own models know
    manifests.py kubernetes FILE...    rendered manifests: Kubernetes' API, strictly
    manifests.py compose FILE...       compose files: the Compose Specification

They need `grafana-foundation-sdk`, `kubernetes-validate` and `check-jsonschema`. Ends with 0 if all is as it should be, 1
with all that is not, 77 where a package is missing.
"""

import json
import subprocess
import sys

MISSING_PACKAGE = 77

# Fields of a dashboard that belong to its data source, Prometheus, of which Grafana's models of dashboards know nothing:
# an annotation's query, and how a variable's query is shown.
OF_THE_DATA_SOURCE = {
    "annotations.list.step",
    "annotations.list.titleFormat",
    "annotations.list.textFormat",
    "annotations.list.tagKeys",
    "annotations.list.useValueForTime",
    "templating.list.definition",
}


def dashboards(files):
    from grafana_foundation_sdk.cog.encoder import JSONEncoder
    from grafana_foundation_sdk.cog.plugins import register_default_plugins
    from grafana_foundation_sdk.models.dashboard import Dashboard

    register_default_plugins()
    for file in files:
        with open(file, encoding="utf-8") as text:
            ours = json.load(text)
        theirs = json.loads(JSONEncoder().encode(Dashboard.from_json(ours)))
        for place, what in differences(ours, theirs):
            if place not in OF_THE_DATA_SOURCE:
                yield f"{file}: {place}: {what}"


def differences(ours, theirs, place=""):
    """What the models did not give back of `ours`: they read the fields that they know."""
    if isinstance(ours, dict) and isinstance(theirs, dict):
        for key, value in ours.items():
            inner = f"{place}.{key}" if place else key
            if key in theirs:
                yield from differences(value, theirs[key], inner)
            elif value is not None:
                yield inner, f"no such field ({json.dumps(value)[:60]})"
    elif isinstance(ours, list) and isinstance(theirs, list) and len(ours) == len(theirs):
        for our, their in zip(ours, theirs):
            yield from differences(our, their, place)
    elif ours != theirs:
        yield place, f"{ours!r} is read as {theirs!r}"


def kubernetes(files):
    import kubernetes_validate
    import yaml

    for file in files:
        with open(file, encoding="utf-8") as text:
            objects = [item for item in yaml.safe_load_all(text) if item]
        if not objects:
            yield f"{file}: nothing in it"
        for item in objects:
            # Of an operator, and of no version of Kubernetes.
            if item["apiVersion"].startswith("monitoring.coreos.com/"):
                continue
            name = f"{item['kind']} {item['metadata']['name']}"
            try:
                kubernetes_validate.validate(item, kubernetes_validate.latest_version(), strict=True)
            except kubernetes_validate.ValidationError as error:
                place = ".".join(str(part) for part in error.path)
                yield f"{file}: {name}: {place}: {error.message}"


def compose(files):
    import check_jsonschema  # noqa: F401

    for file in files:
        command = [sys.executable, "-m", "check_jsonschema", "--builtin-schema", "vendor.compose-spec", file]
        checked = subprocess.run(command, capture_output=True, text=True)
        if checked.returncode:
            yield checked.stdout + checked.stderr


def main():
    check = {"dashboards": dashboards, "kubernetes": kubernetes, "compose": compose}[sys.argv[1]]
    try:
        wrong = list(check(sys.argv[2:]))
    except ImportError as error:
        print(f"skipped: {error}")
        sys.exit(MISSING_PACKAGE)
    print("\n".join(wrong))
    sys.exit(bool(wrong))


main()
