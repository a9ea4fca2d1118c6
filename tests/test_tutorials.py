"""Every tutorial in docs/ runs as it is written: its files are written, its commands and its Python are executed.

What a tutorial only repeats is left out, see `SMALLER`.
"""

import contextlib
import io
import os
import re
import shlex
import shutil
import subprocess
import sys
from pathlib import Path
from xml.etree import ElementTree

import pytest

from benchmarks import cli

DOCS = Path(__file__).parents[1] / "docs"
BLOCK = re.compile(r"^```(\w+)\n(.*?)^```$", re.MULTILINE | re.DOTALL)
SMALLER = {"ablation": ("seeds = 2", "seeds = 1")}  # test_author_table.py tests tables of several values.


@pytest.fixture
def folder(ci_data: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Where the user stands, beside a capture that is there already: it is made once for all."""
    shutil.copytree(ci_data, tmp_path / "data", copy_function=os.link)
    monkeypatch.chdir(tmp_path)
    return tmp_path


def run_tutorial(name: str, *, apart: bool = False) -> list[str]:
    """Execute the fenced blocks of a tutorial in the current folder, in their order; what its commands printed.

    A block whose first line is `# NAME.SUFFIX` is a file. `sh` blocks hold one command a line, which must exit with 0,
    or with N where the line ends in `# exit code N`. `python` blocks share their names, as the cells of a notebook.
    `apart`: every command is a process of its own, for a tutorial that changes the code that they import.
    """
    names: dict[str, object] = {}
    told = []
    written = (DOCS / f"{name}.md").read_text()
    before, after = SMALLER.get(name, ("", ""))
    assert not before or written.count(before) == 1
    for language, text in BLOCK.findall(written.replace(before, after) if before else written):
        if named := re.match(r"# (\S+\.\w+)\n", text):
            path = Path(named.group(1))
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_text(text)
        elif language == "sh":
            for line in filter(None, text.splitlines()):
                told.append(run_command(line, apart=apart))
        elif language == "python":
            exec(compile(text, f"{name}.md", "exec"), names)
        else:
            raise AssertionError(f"{name}.md: a block of {language!r} that is no file")
    return told


def run_command(line: str, *, apart: bool) -> str:
    """Run one line of a shell block; what it printed."""
    command, _, comment = line.partition("  # exit code ")
    program, *words = shlex.split(command, comments=True)
    if apart:
        whole = {"./ash-bench": [sys.executable, "-m", "benchmarks.cli"], "git": ["git"]}[program]
        done = subprocess.run([*whole, *words], capture_output=True, text=True, check=False)
        assert done.returncode == int(comment or 0), f"{line}\n{done.stdout}\n{done.stderr}"
        return done.stdout
    assert program == "./ash-bench"
    with contextlib.redirect_stdout(io.StringIO()) as printed:
        code = cli.main(words)
    assert code == int(comment or 0), f"{line}\n{printed.getvalue()}"
    return printed.getvalue()


@pytest.mark.timeout(900)  # Commands of minutes where other work runs beside them.
@pytest.mark.parametrize("name", ["ablation", "import", "predictions", "truth"])
def test_a_tutorial_runs_as_it_is_written(name: str, folder: Path) -> None:
    run_tutorial(name)


@pytest.mark.timeout(900)
def test_the_tutorial_of_the_gate_ends_with_a_method_that_is_slower(folder: Path) -> None:
    """After one that is darker, which it accepts."""
    told = run_tutorial("gate", apart=True)
    _, _, unchanged, darker, *_, slower = told
    assert "gate: passed, unchanged" in unchanged
    assert "rendering changed: 32 of 32 pictures" in darker
    assert "mean_image: darker on purpose" in slower, "it was accepted"
    assert "worse                  mannequin · mean_image: cost: time of frame" in slower
    assert "rendering changed" not in slower
    assert "unchanged" in Path("gate/summary.md").read_text()
    cases = ElementTree.parse("gate/junit.xml").getroot()
    assert len(cases) > 3 and not list(cases.iter("failure"))
    assert Path("gate/rendering_0.png").read_bytes()[:4] == b"\x89PNG"
    assert run_command("git -C repository status --porcelain", apart=True).splitlines()[0] == " M mean_image.py"
