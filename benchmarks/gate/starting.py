"""A gate in a repository of one's own: its suite, and a GitHub workflow that runs it on every pull request."""

import shlex
from pathlib import Path

from ash.files import InputError, write_atomic
from benchmarks.cell.registry import find_method, find_spec_of, offered

WORKFLOW = Path(".github/workflows/gate.yml")

SUITE = """\
about = "{name} on the smallest scene"
scenes = ["mannequin"]
size = "ci"
methods = [{{ of = "{method}", name = "{name}" }}]
preset = "ci"
"""

# `gh` comes with GitHub's machines; the token is the workflow's own. An installed method would come before that of
# `--method-path`, which is another one for each revision.
STEPS = """\
# Is this change worse or slower than the committed baseline? One comment per pull request, updated in place.
name: gate
on:
  pull_request:
permissions:
  contents: read
  pull-requests: write
jobs:
  gate:
    runs-on: ubuntu-24.04
    timeout-minutes: 60
    steps:
      - uses: actions/checkout@v4
        with:
          fetch-depth: 0 # Times are compared with those of the base, drawn in turn on this machine.
      - uses: actions/setup-python@v5
        with:
          python-version: "3.11"
      # ASH_BENCH: where ash-bench is cloned from, a variable of the repository.
      - run: git clone --depth 1 "${{ vars.ASH_BENCH }}" ash-bench && ash-bench/ash-bench doctor
      # What the method needs, and not the method itself, which --method-path finds.
      - if: hashFiles('pyproject.toml') != ''
        run: |
          ash-bench/.venv/bin/pip install .
          named='import tomllib; print(tomllib.load(open("pyproject.toml", "rb"))["project"]["name"])'
          ash-bench/.venv/bin/pip uninstall --yes "$(ash-bench/.venv/bin/python -c "$named")"
      - uses: actions/cache@v4
        with:
          path: data
          key: captures-${{ hashFiles('gate/*.toml') }}
      - run: >-
          ash-bench/ash-bench --method-path METHOD_ROOT gate --baseline gate/baseline --out runs/gate
          --against ${{ github.event.pull_request.base.sha }} --markdown gate.md --junit gate.xml
      - if: always()
        run: cat gate.md >> "$GITHUB_STEP_SUMMARY"
      - if: always()
        run: gh pr comment ${{ github.event.number }} --body-file gate.md --edit-last --create-if-none
        env:
          GH_TOKEN: ${{ github.token }}
      - if: always()
        uses: actions/upload-artifact@v4
        with:
          name: gate
          path: |
            gate.md
            gate.xml
            runs/gate/rendering_*.png
"""


def start(method: str, folder: Path) -> Path:
    """Write the suite of a method into `folder` and the workflow beside it; returns the suite's file.

    Raises:
        InputError: the method cannot be imported or lies elsewhere, or a file is there already.
    """
    offered(method, "ci")
    root = _root_of(method)
    name = method.rpartition(":")[2]
    suite = folder / f"{name}.toml"
    for path in (suite, WORKFLOW):
        if path.exists():
            raise InputError(f"{path}: is there already; expected a repository without a gate")
    write_atomic(suite, SUITE.format(method=method, name=name).encode())
    write_atomic(WORKFLOW, STEPS.replace("METHOD_ROOT", shlex.quote(root)).encode())
    return suite


def _root_of(method: str) -> str:
    """The folder that a method is imported from, relative to the repository in which we stand."""
    module = find_method(method).target.partition(":")[0]
    spec = find_spec_of(module)
    assert spec is not None and spec.origin is not None, "it was imported"
    file = Path(spec.origin).resolve()
    root = file.parents[module.count(".") + (file.name == "__init__.py")]
    if not root.is_relative_to(Path.cwd()):
        raise InputError(f"{method}: expected a module of the repository in {Path.cwd()}, got one of {root}")
    return str(root.relative_to(Path.cwd()))
