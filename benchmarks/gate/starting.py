"""A gate in a repository of one's own: its suite, and a GitHub workflow that runs it on pull requests and merges."""

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

# An installed method would come before that of `--method-path`, which is another one for each revision.
SETUP = """\
    runs-on: ubuntu-24.04
    timeout-minutes: 60
    steps:
      - uses: actions/checkout@v4
        with:
          fetch-depth: 0 # Of a pull request, times are compared with those of the base, drawn in turn on this machine.
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
"""

# `gh` comes with GitHub's machines; the token is the workflow's own. Only what was merged may write to the repository.
WORKFLOW_TEXT = f"""\
# Is this change worse or slower than the committed baseline? One comment per pull request, updated in place.
# After a merge the scores and times of the commit are appended to the branch gate-history, whose index.html has charts.
name: gate
on:
  pull_request:
  push:
    branches: [main, master]
jobs:
  gate:
    if: github.event_name == 'pull_request'
    permissions:
      contents: read
      pull-requests: write
{SETUP}\
      - run: >-
          ash-bench/ash-bench --method-path METHOD_ROOT gate --baseline gate/baseline --out runs/gate
          --against ${{{{ github.event.pull_request.base.sha }}}} --markdown gate.md --junit gate.xml
      - if: always()
        run: cat gate.md >> "$GITHUB_STEP_SUMMARY"
      - if: always()
        run: gh pr comment ${{{{ github.event.number }}}} --body-file gate.md --edit-last --create-if-none
        env:
          GH_TOKEN: ${{{{ github.token }}}}
      - if: always()
        uses: actions/upload-artifact@v4
        with:
          name: gate
          path: |
            gate.md
            gate.xml
            runs/gate/rendering_*.png
  history:
    if: github.event_name == 'push'
    permissions:
      contents: write
    concurrency: gate-history
{SETUP}\
      - run: |
          if ! git worktree add history gate-history; then
            git worktree add --detach history
            git -C history switch --orphan gate-history
          fi
          # Exit code 1: a commit that is worse belongs to the history.
          ash-bench/ash-bench --method-path METHOD_ROOT gate --baseline gate/baseline --out runs/gate \\
            --history history || [ $? = 1 ]
          git -C history add history.jsonl index.html
          git -C history -c user.name=gate -c user.email=gate@localhost commit --message "$GITHUB_SHA"
          git -C history push origin gate-history
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
    write_atomic(WORKFLOW, WORKFLOW_TEXT.replace("METHOD_ROOT", shlex.quote(root)).encode())
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
