"""Every tutorial in docs/ runs as it is written: its files are written, its commands and its Python are executed."""

import os
import re
import shlex
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

DOCS = Path(__file__).parents[1] / "docs"
BLOCK = re.compile(r"^```(\w+)\n(.*?)^```$", re.MULTILINE | re.DOTALL)
TUTORIALS = ("ablation", "gate", "import", "predictions", "truth")


def run_tutorial(name: str, folder: Path) -> None:
    """Execute the fenced blocks of a tutorial in `folder`, in their order.

    A block whose first line is `# NAME.SUFFIX` is a file. `sh` blocks hold one command a line, which must exit with 0,
    or with N where the line ends in `# exit code N`. `python` blocks share one interpreter, as the cells of a notebook.
    """
    python = ""
    for language, text in BLOCK.findall((DOCS / f"{name}.md").read_text()):
        if named := re.match(r"# (\S+\.\w+)\n", text):
            path = folder / named.group(1)
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_text(text)
        elif language == "sh":
            for line in filter(None, text.splitlines()):
                run_command(line, folder)
        elif language == "python":
            python += text
            done = subprocess.run(
                [sys.executable, "-c", python], cwd=folder, capture_output=True, text=True, check=False
            )
            assert done.returncode == 0, f"{text}\n{done.stderr}"
        else:
            raise AssertionError(f"{name}.md: a block of {language!r} that is no file")


def run_command(line: str, folder: Path) -> None:
    """Run one line of a shell block."""
    command, _, comment = line.partition("  # exit code ")
    words = shlex.split(command, comments=True)
    program = {"./ash-bench": [sys.executable, "-m", "benchmarks.cli"], "git": ["git"]}[words[0]]
    done = subprocess.run([*program, *words[1:]], cwd=folder, capture_output=True, text=True, check=False)
    assert done.returncode == int(comment or 0), f"{line}\n{done.stdout}\n{done.stderr}"


@pytest.mark.timeout(900)  # Commands of minutes where other work runs beside them.
@pytest.mark.parametrize("name", TUTORIALS)
def test_a_tutorial_runs_as_it_is_written(name: str, ci_data: Path, tmp_path: Path) -> None:
    """On a capture that is there already: it is made once for all."""
    shutil.copytree(ci_data, tmp_path / "data", copy_function=os.link)
    run_tutorial(name, tmp_path)
