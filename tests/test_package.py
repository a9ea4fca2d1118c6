"""What is installed: the wheel's contents, exact versions, and the direction of imports."""

import ast
import os
import re
import subprocess
import sys
import tomllib
import zipfile
from importlib.metadata import PackageNotFoundError, distribution
from importlib.util import find_spec
from pathlib import Path

import pytest

from benchmarks.cli import COMMANDS

ROOT = Path(__file__).parents[1]
PACKAGES = ("ash", "synth", "baselines", "benchmarks")
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())


@pytest.fixture(scope="module")
def wheel(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The unpacked wheel, without the kernels: compiling them takes longer than all the rest of this file."""
    if find_spec("scikit_build_core") is None:
        pytest.skip("building a wheel needs scikit-build-core, which ./ash-bench installs")
    folder = tmp_path_factory.mktemp("wheel")
    # A copy is built, because the build may leave files behind.
    listed = subprocess.run(["git", "ls-files", "-co", "--exclude-standard"], cwd=ROOT, capture_output=True, text=True)
    names = listed.stdout.split() if listed.returncode == 0 else []
    for name in names or [path.relative_to(ROOT).as_posix() for path in ROOT.rglob("*") if path.suffix != ".pyc"]:
        if (ROOT / name).is_file() and name.split("/")[0] in (
            *PACKAGES,
            "pyproject.toml",
            "README.md",
            "LICENSE",
            "tests",
        ):
            (folder / "source" / name).parent.mkdir(parents=True, exist_ok=True)
            (folder / "source" / name).write_bytes((ROOT / name).read_bytes())
    build = "import sys; from scikit_build_core.build import build_wheel as f; f(sys.argv[1], {'wheel.cmake': 'false'})"
    subprocess.run([sys.executable, "-c", build, str(folder)], cwd=folder / "source", check=True, capture_output=True)
    (built,) = folder.glob("*.whl")
    zipfile.ZipFile(built).extractall(folder / "unpacked")
    return folder / "unpacked"


def test_wheel_holds_the_four_packages_and_the_licence(wheel: Path) -> None:
    (info,) = wheel.glob("*.dist-info")
    assert {path.name for path in wheel.iterdir()} - {info.name} == set(PACKAGES)
    assert "Apache License" in (info / "licenses" / "LICENSE").read_text()
    for package in PACKAGES:
        sources = {path.relative_to(ROOT) for path in (ROOT / package).rglob("*.py")}
        assert {path.relative_to(wheel) for path in (wheel / package).rglob("*.py")} == sources
    assert {path.name for path in (wheel / "benchmarks" / "report" / "templates").iterdir()} == {
        path.name for path in (ROOT / "benchmarks" / "report" / "templates").iterdir() if path.is_file()
    }
    suites = {path.name for path in (ROOT / "benchmarks" / "suites").glob("*.toml")}
    assert {path.name for path in (wheel / "benchmarks" / "suites").glob("*.toml")} == suites != set()


def test_wheel_works_outside_the_checkout(wheel: Path, tmp_path: Path) -> None:
    """`-S` leaves out the editable installation that these tests run from."""
    program = f"""
import sys
sys.path[:0] = [{str(wheel)!r}]
sys.path += {[path for path in sys.path if path.endswith("-packages")]!r}
import ash.capture.dataset, synth.scene
from importlib.metadata import entry_points
from benchmarks.cli import main
assert ash.capture.dataset.__file__.startswith({str(wheel)!r})
main(["--help"])
"""
    done = subprocess.run(
        [sys.executable, "-S", "-c", program],
        cwd=tmp_path,
        env={name: value for name, value in os.environ.items() if name != "PYTHONPATH"},
        capture_output=True,
        text=True,
    )
    assert done.returncode == 0, done.stderr
    assert "ash-bench run" in done.stdout


def test_methods_can_be_imported() -> None:
    for name, target in PROJECT["project"]["entry-points"]["ash_bench.methods"].items():
        module, function = target.split(":")
        spec = find_spec(module)
        assert spec is not None and spec.origin is not None, f"{name}: no module {module}"
        body = ast.parse(Path(spec.origin).read_text()).body
        defined = [node.name for node in body if isinstance(node, ast.FunctionDef)]
        targets = [target for node in body if isinstance(node, ast.Assign) for target in node.targets]
        defined += [name.id for target in targets for name in ast.walk(target) if isinstance(name, ast.Name)]
        assert function in defined, f"{name}: {module} defines no {function}"


def canonical(name: str) -> str:
    return re.sub(r"[-_.]+", "-", name).lower()


def constraints() -> dict[str, str]:
    lines = (ROOT / "constraints.txt").read_text().splitlines()
    pairs = [line.split("==") for line in lines if line and not line.startswith("#")]
    return {canonical(name): version for name, version in pairs}


def closure() -> set[str]:
    """Every distribution that an installation with all extras brings along, as far as it is installed here."""
    project = PROJECT["project"]
    waiting = [*project["dependencies"], *PROJECT["build-system"]["requires"]]
    waiting += [requirement for extra in project["optional-dependencies"].values() for requirement in extra]
    found: set[str] = set()
    while waiting:
        requirement = waiting.pop()
        name = canonical(re.split(r"[^A-Za-z0-9._-]", requirement.strip(), maxsplit=1)[0])
        if "extra ==" in requirement or name in found or not _wanted_here(requirement):
            continue
        found.add(name)
        try:
            waiting += distribution(name).requires or []
        except PackageNotFoundError:
            continue
    return found


def _wanted_here(requirement: str) -> bool:
    from packaging.requirements import Requirement

    marker = Requirement(requirement).marker
    return marker is None or marker.evaluate()


def test_constraints_hold_every_package_to_one_version() -> None:
    pinned = constraints()
    # A build of torch for GPUs brings libraries of its vendor along, and holds them to exact versions itself.
    unpinned = {name for name in closure() - set(pinned) if not name.startswith(("nvidia-", "cuda-", "triton"))}
    assert unpinned == set()
    assert all(re.fullmatch(r"[0-9][0-9A-Za-z.]*", version) for version in pinned.values()), "expected plain versions"


def test_the_constraints_for_cuda_hold_the_same_torch_and_name_no_place() -> None:
    lines = (ROOT / "constraints-cuda.txt").read_text().splitlines()
    pinned = dict(line.split("==") for line in lines if not line.startswith("#"))
    common = pinned.keys() & constraints().keys()
    assert {name: pinned[name] for name in common} == {name: constraints()[name] for name in common}
    assert "torch" in common and {"triton", "nvidia-cudnn-cu13", "cuda-toolkit"} <= pinned.keys()
    assert not [line for line in lines if "://" in line or line.startswith("-")]


def test_the_hashed_constraints_hold_the_same_versions() -> None:
    text = (ROOT / "constraints-linux-x86_64-cp311.txt").read_text()
    found = re.findall(r"^(\S+)==(\S+) \\\n((?:    --hash=sha256:[0-9a-f]{64}(?: \\)?\n)+)", text, re.MULTILINE)
    assert len(found) == len([line for line in text.splitlines() if line and line[0] not in "# "]), "each has a hash"
    several_builds = {"torch", "torchvision"}
    pinned = {name: version for name, version in constraints().items() if name not in several_builds}
    assert {canonical(name): version for name, version, _ in found} == pinned


def test_workflows_run_actions_of_one_commit() -> None:
    text = "".join(path.read_text() for path in sorted((ROOT / ".github").rglob("*.yml")))
    used = re.findall(r"uses: (\S+)", text)
    assert used and all(re.fullmatch(r"\./\.github/actions/\w+|\S+@[0-9a-f]{40}", action) for action in used)


def test_imports_follow_the_contracts() -> None:
    done = subprocess.run(
        [sys.executable, "-c", "from importlinter.cli import lint_imports_command as f; f()"],
        cwd=ROOT,
        capture_output=True,
        text=True,
    )
    assert done.returncode == 0, done.stdout


def test_torchvision_is_never_imported() -> None:
    """lpips brings it along, and beside a CPU build of torch its import fails."""
    for package in PACKAGES:
        for path in (ROOT / package).rglob("*.py"):
            text = path.read_text()
            for node in ast.walk(ast.parse(text)) if "torchvision" in text or "lpips" in text else ():
                names = [alias.name for alias in node.names] if isinstance(node, ast.Import) else []
                names += [node.module or ""] if isinstance(node, ast.ImportFrom) else []
                assert not {name.split(".")[0] for name in names} & {"torchvision", "lpips"}, path


@pytest.mark.parametrize("document", ["README.md", "ARCHITECTURE.md", "CONTRIBUTING.md", "docs/plugin.md"])
def test_documents_name_files_and_commands_that_exist(document: str) -> None:
    text = (ROOT / document).read_text()
    named = set(re.findall(r"\b(?:ash|synth|baselines|benchmarks|tests|docs|reports)/[\w/.-]*[\w/]", text))
    assert [name for name in sorted(named) if not (ROOT / name).exists()] == []
    linked = re.findall(r"\]\((?!https?:)([^)#]+)\)", text)
    assert [name for name in linked if not ((ROOT / document).parent / name).exists()] == []
    commands = set(re.findall(r"\./ash-bench ([a-z][a-z-]*)", text))
    known = set(COMMANDS)
    assert commands <= known


def test_contracts_allow_only_what_they_name() -> None:
    """import-linter forbids by name; a new module of ash is forbidden to synth and cells until it is allowed here."""
    modules = {f"ash.{path.stem}" for path in (ROOT / "ash").iterdir() if path.suffix == ".py" or path.is_dir()}
    modules -= {"ash.__init__", "ash.__pycache__", "ash.capture", "ash.files"}
    contracts = PROJECT["tool"]["importlinter"]["contracts"]
    walls = [contract for contract in contracts if contract["type"] == "forbidden"]
    assert sum(modules - {"ash.protocol", "ash.fields"} <= set(wall["forbidden_modules"]) for wall in walls) == 3


def test_the_architecture_states_the_direction_of_imports_that_is_checked() -> None:
    text = (ROOT / "ARCHITECTURE.md").read_text()
    contracts = PROJECT["tool"]["importlinter"]["contracts"]
    (packages,) = [c["layers"] for c in contracts if c["type"] == "layers" and c["layers"][-1] == "ash"]
    (layers,) = [c["layers"] for c in contracts if c.get("containers") == ["benchmarks"]]
    assert f"packages    {' -> '.join(packages)}\n" in text
    assert f"benchmarks  {' -> '.join(layers)}\n" in text


def test_the_architecture_lists_every_difference_from_the_paper() -> None:
    from ash.fields import flat
    from ash.presets import named, plus

    text = (ROOT / "ARCHITECTURE.md").read_text()
    configs = [flat(config) for config in (named("paper"), named("cpu"), plus("cpu"))]
    expected = {name: [str(config[name]) for config in configs] for name in configs[0]}
    expected = {name: values for name, values in expected.items() if len(set(values)) > 1}
    listed = re.findall(r"^\| `((?:model|training|template)\.\w+)` \| (.*?) \| (.*?) \| (.*?) \| (.+) \|$", text, re.M)
    assert {name: values for name, *values, _ in listed} == expected
    for name, paper, ash, ash_plus, why in listed:  # Only what is named as an addition separates the two.
        assert (
            bool(re.search(r"(^|^smaller; )addition `", why)) == (ash != ash_plus) or name == "training.warmup_steps"
        ), name
        assert why.startswith(("smaller", "the same", "engineering")) or ash == paper, name
