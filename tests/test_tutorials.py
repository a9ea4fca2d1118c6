"""Every tutorial in docs/ runs as it is written: its files are written, its commands and its Python are executed."""

import os
import re
import shlex
import shutil
import subprocess
import sys
from pathlib import Path
from xml.etree import ElementTree

import pytest

DOCS = Path(__file__).parents[1] / "docs"
BLOCK = re.compile(r"^```(\w+)\n(.*?)^```$", re.MULTILINE | re.DOTALL)


@pytest.fixture
def folder(ci_data: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Where the user stands, beside a capture that is there already: it is made once for all."""
    shutil.copytree(ci_data, tmp_path / "data", copy_function=os.link)
    monkeypatch.chdir(tmp_path)
    return tmp_path


def run_tutorial(name: str) -> list[str]:
    """Execute the fenced blocks of a tutorial in the current folder, in their order; what its commands printed.

    A block whose first line is `# NAME.SUFFIX` is a file. `sh` blocks hold one command a line, which must exit with 0,
    or with N where the line ends in `# exit code N`. `python` blocks share their names, as the cells of a notebook.
    """
    names: dict[str, object] = {}
    told = []
    for language, text in BLOCK.findall((DOCS / f"{name}.md").read_text()):
        if named := re.match(r"# (\S+\.\w+)\n", text):
            path = Path(named.group(1))
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_text(text)
        elif language == "sh":
            for line in filter(None, text.splitlines()):
                told.append(run_command(line))
        elif language == "python":
            exec(compile(text, f"{name}.md", "exec"), names)
        else:
            raise AssertionError(f"{name}.md: a block of {language!r} that is no file")
    return told


def run_command(line: str) -> str:
    """Run one line of a shell block; what it printed."""
    command, _, comment = line.partition("  # exit code ")
    words = shlex.split(command, comments=True)
    program = {"./ash-bench": [sys.executable, "-m", "benchmarks.cli"], "git": ["git"]}[words[0]]
    done = subprocess.run([*program, *words[1:]], capture_output=True, text=True, check=False)
    assert done.returncode == int(comment or 0), f"{line}\n{done.stdout}\n{done.stderr}"
    return done.stdout


@pytest.mark.timeout(900)  # Commands of minutes where other work runs beside them.
@pytest.mark.parametrize("name", ["ablation", "import", "predictions", "truth"])
def test_a_tutorial_runs_as_it_is_written(name: str, folder: Path) -> None:
    run_tutorial(name)


@pytest.mark.timeout(900)
def test_the_tutorial_of_the_gate_ends_with_a_method_that_is_slower(folder: Path) -> None:
    """After one that is darker, which it accepts."""
    told = run_tutorial("gate")
    _, _, unchanged, darker, _, accepted, *_, slower = told
    assert "gate: passed, unchanged" in unchanged
    assert "rendering changed: 32 of 32 pictures" in darker
    assert "mean_image: darker on purpose" in accepted
    assert "worse                  mannequin · mean_image: cost: time of frame" in slower
    assert "rendering changed" not in slower
    assert "unchanged" in Path("gate/summary.md").read_text()
    cases = ElementTree.parse("gate/junit.xml").getroot()
    assert len(cases) > 3 and not list(cases.iter("failure"))
    assert Path("gate/rendering_0.png").read_bytes()[:4] == b"\x89PNG"
    assert run_command("git -C repository status --porcelain").splitlines()[0] == " M mean_image.py"
