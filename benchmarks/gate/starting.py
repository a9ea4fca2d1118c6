"""A gate in a repository of one's own: its suite, and a GitHub workflow that runs it on every pull request."""

from pathlib import Path

from ash.files import InputError, write_atomic
from benchmarks.cell.registry import offered

WORKFLOW = Path(".github/workflows/gate.yml")

SUITE = """\
about = "{name} on the smallest scene"
scenes = ["mannequin"]
size = "ci"
methods = [{{ of = "{method}", name = "{name}" }}]
preset = "ci"
"""

# `gh` comes with GitHub's machines; the token is the workflow's own.
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
      - uses: actions/setup-python@v5
        with:
          python-version: "3.11"
      # ASH_BENCH: where ash-bench is cloned from, a variable of the repository.
      - run: git clone --depth 1 "${{ vars.ASH_BENCH }}" ash-bench && ash-bench/ash-bench doctor
      - run: ash-bench/.venv/bin/pip install -e .
      - uses: actions/cache@v4
        with:
          path: data
          key: captures-${{ hashFiles('gate/*.toml') }}
      - run: ash-bench/ash-bench gate --baseline gate/baseline --out runs/gate --markdown gate.md --junit gate.xml
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
        InputError: the method cannot be imported, or a file is there already.
    """
    offered(method, "ci")
    name = method.rpartition(":")[2]
    suite = folder / f"{name}.toml"
    for path in (suite, WORKFLOW):
        if path.exists():
            raise InputError(f"{path}: is there already; expected a repository without a gate")
    write_atomic(suite, SUITE.format(method=method, name=name).encode())
    write_atomic(WORKFLOW, STEPS.encode())
    return suite
