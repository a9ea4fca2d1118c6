"""A method that changed is another method: its sources are part of what names a cell."""

import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from benchmarks.cell.registry import baseline_sources, code_version, imported_from, sources_below

PROJECT = """
[build-system]
requires = ["setuptools"]
build-backend = "setuptools.build_meta"
[project]
name = "stranger"
version = "1.0"
[project.entry-points."ash_bench.methods"]
stranger = "stranger:make"
[tool.setuptools]
packages = ["stranger", "stranger_nets"]
"""


def write_project(folder: Path) -> Path:
    files = {
        "pyproject.toml": PROJECT,
        "stranger/__init__.py": "from stranger_nets.net import width\ndef make(capture, *, seed, preset): ...\n",
        "stranger/losses.py": "weight = 1\n",
        "stranger_nets/__init__.py": "",
        "stranger_nets/net.py": "width = 8\n",
    }
    for name, text in files.items():
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_text(text)
    return folder


def version_of(method: str, *places: Path) -> str:
    """As a new process sees it, with these places on its path."""
    with pytest.MonkeyPatch.context() as patch:
        for place in reversed(places):
            patch.syspath_prepend(str(place))
        return code_version.__wrapped__(method)


def test_an_installed_plugin_that_changed_is_another_method(tmp_path: Path) -> None:
    pytest.importorskip("setuptools", reason="building the package needs setuptools")
    source, site = write_project(tmp_path / "source"), tmp_path / "site"
    options = ["--no-index", "--no-deps", "--no-build-isolation", "--disable-pip-version-check", "--target", str(site)]
    done = subprocess.run([sys.executable, "-m", "pip", "install", "-q", *options, str(source)], check=False)
    assert done.returncode == 0
    before = version_of("stranger", site)
    (site / "README.md").write_text("no source\n")
    assert version_of("stranger", site) == before
    known = {before}
    for changed in ("stranger/__init__.py", "stranger/losses.py", "stranger_nets/net.py"):
        with (site / changed).open("a") as file:
            file.write("# changed\n")
        known.add(version_of("stranger", site))
    assert len(known) == 4


def test_an_editable_plugin_that_changed_is_another_method(tmp_path: Path) -> None:
    source, site = write_project(tmp_path / "source"), tmp_path / "site"
    info = site / "stranger-1.0.dist-info"
    info.mkdir(parents=True)
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: stranger\nVersion: 1.0\n")
    (info / "entry_points.txt").write_text("[ash_bench.methods]\nstranger = stranger:make\n")
    (info / "RECORD").write_text("stranger-1.0.dist-info/METADATA,,\n")
    (info / "direct_url.json").write_text(f'{{"url": "file://{source}", "dir_info": {{"editable": true}}}}')
    before = version_of("stranger", site, source)
    (source / ".venv").mkdir()
    (source / ".venv" / "other.py").write_text("not ours\n")
    assert version_of("stranger", site, source) == before
    known = {before}
    for changed in ("stranger/losses.py", "stranger_nets/net.py"):
        with (source / changed).open("a") as file:
            file.write("# changed\n")
        known.add(version_of("stranger", site, source))
    assert len(known) == 3


def test_a_factory_by_its_path_follows_what_it_imports_beside_it(tmp_path: Path) -> None:
    (tmp_path / "mine.py").write_text("def make(capture, *, seed, preset):\n    import parts\n")
    (tmp_path / "parts.py").write_text("from deeper import net\n")
    (tmp_path / "deeper").mkdir()
    (tmp_path / "deeper" / "net.py").write_text("width = 8\n")
    (tmp_path / "unrelated.py").write_text("")
    names = {path.name for path in imported_from(tmp_path / "mine.py")}
    assert names == {"mine.py", "parts.py", "net.py"}
    before = version_of("mine:make", tmp_path)
    (tmp_path / "unrelated.py").write_text("x = 1\n")
    assert version_of("mine:make", tmp_path) == before
    (tmp_path / "deeper" / "net.py").write_text("width = 9\n")
    assert version_of("mine:make", tmp_path) != before


def test_environments_and_builds_are_no_sources(tmp_path: Path) -> None:
    write_project(tmp_path)
    before = sources_below(tmp_path)
    for place in ("build/lib/a.py", "env/lib/a.py", ".git/a.py", "stranger/__pycache__/a.py"):
        (tmp_path / place).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / place).write_text("")
    (tmp_path / "env" / "pyvenv.cfg").write_text("")
    assert sources_below(tmp_path) == before
    shutil.rmtree(tmp_path / "env")


def test_our_own_methods_follow_the_baselines_that_they_import_alone() -> None:
    def names(target: str) -> set[str]:
        return {path.name for path in baseline_sources(target)}

    assert names("ash.presets:ash") == set()
    assert names("baselines.field:tava") == {"field.py", "mlp.py"}
    assert {"ablations.py", "ddc.py"} <= names("baselines.ablations:wo_mot")
    assert "field.py" not in names("baselines.ablations:wo_mot") | names("baselines.ddc:ddc")
    assert code_version("ash") == code_version("ash_plus") != code_version("ddc") != code_version("tava")
