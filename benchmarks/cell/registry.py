"""Which methods there are, who of them may see the truth, and which sources decide their outcome."""

import ast
import contextlib
import hashlib
import json
import os
import re
import sys
import traceback
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cache
from importlib import import_module
from importlib.machinery import ModuleSpec
from importlib.metadata import Distribution, PackageNotFoundError, distribution, entry_points
from importlib.util import find_spec
from pathlib import Path
from typing import Any
from urllib.parse import unquote, urlsplit

from ash.capture.dataset import Capture
from ash.fields import Changes, apply_overrides, flat, suggest
from ash.files import InputError, hash_sources
from ash.protocol import Configurable
from benchmarks.aliases import OLD_FIELDS, OLD_METHODS

SUFFIXES = frozenset({".py", ".pyi", ".so", ".pyd", ".cpp", ".cc", ".cu", ".c", ".h", ".hpp", ".cuh", ".inc", ".toml"})
NOT_SOURCES = frozenset({"build", "dist", "node_modules", "site-packages", "__pycache__"})

METHOD_GROUP = "ash_bench.methods"
LONGEST_NAME = 200  # characters of `package.module:factory`


TEMPLATE_ERRORS_MM = (0, 2, 4, 8, 16)
ON_EXACT = ("ash_truth", "ddc_truth", "oracle_texture")
WRONG_BY_MM = {
    mm: ON_EXACT if mm == 0 else (f"ash_{mm}mm", f"ddc_{mm}mm", f"texture_{mm}mm") for mm in TEMPLATE_ERRORS_MM
}
# Who may look at truth/ is decided here, not by the method: these get the whole capture, all others its training part.
ORACLES = frozenset().union(*WRONG_BY_MM.values())

BROUGHT = "predictions"  # the source of a cell whose pictures were rendered elsewhere; of a row, `predictions:DIR`

ROW_NAME = re.compile(r"[\w.:]*")  # what a row's name begins with; how it differs from that method follows


# Whose sources decide a cell's outcome, besides this folder; a change elsewhere (a report, say) leaves results valid.
DECIDING_PACKAGES = ("ash", "baselines")
OUR_PACKAGES = (*DECIDING_PACKAGES, "benchmarks", "synth")


@dataclass(frozen=True, kw_only=True, slots=True)
class Method:
    """An installed method: where its factory is (`package.module:function`) and which distribution brought it."""

    name: str
    target: str
    distribution: str

    @property
    def is_ours(self) -> bool:
        """Whether its sources are among those that are hashed."""
        return self.target.split(".")[0] in DECIDING_PACKAGES

    def load(self) -> Callable[..., Any]:
        """Import the factory."""
        module, _, function = self.target.partition(":")
        factory: Callable[..., Any] = getattr(import_module(module), function)
        return factory


def is_oracle(row: str) -> bool:
    """Whether a row's method is shown the truth, and so is a bound and no competitor.

    A variant of an oracle begins with the oracle's name, such as `ash_truth+texels=64`; suites see to it.
    """
    return named_method(row) in set(map(named_method, ORACLES))


def named_method(row: str) -> str:
    """The method whose name a row's name begins with; of `package.module:factory`, the factory."""
    matched = ROW_NAME.match(row)
    return (matched.group() if matched else row).rpartition(":")[2]


def brought_folder(of: str) -> Path | None:
    """DIR of `predictions:DIR`, pictures that were rendered elsewhere; None for a method."""
    prefix = f"{BROUGHT}:"
    return Path(of.removeprefix(prefix)) if of.startswith(prefix) else None


def methods() -> dict[str, Method]:
    """All installed methods, ours and anyone's."""
    return _installed(tuple(sys.path))


@cache
def _installed(path: tuple[str, ...]) -> dict[str, Method]:
    """The entry points of the distributions on `path`, which is `sys.path`: each takes reading a file."""
    entries = sorted(entry_points(group=METHOD_GROUP), key=lambda entry: entry.name)
    distributions = {id(entry.dist): entry.dist for entry in entries if entry.dist is not None}
    named = {key: f"{dist.name} {dist.version}" for key, dist in distributions.items()}  # Each reads a file.
    return {
        entry.name: Method(name=entry.name, target=entry.value, distribution=named.get(id(entry.dist), ""))
        for entry in entries
    }


def find_method(name: str) -> Method:
    """An installed method by name, or any importable factory as `package.module:function`."""
    if len(name) > LONGEST_NAME:
        raise InputError(f"unknown method {name[:40]}...: expected a name of at most {LONGEST_NAME} characters")
    if ":" in name and find_spec_of(name) is not None:
        return Method(name=name, target=name, distribution="")
    known = methods()
    name = name if name in known else OLD_METHODS.get(name, name)
    if name not in known:
        hint = "; --method-path DIR adds a folder where it is looked for" if ":" in name else ""
        raise InputError(f"unknown method {name!r}, {suggest(name, tuple(known))}{hint}")
    return known[name]


def offered(name: str, preset: str) -> Any:
    """The configuration that a preset means to a method; None where the method offers none.

    Raises:
        InputError: an unknown method or preset.
    """
    method = find_method(name)
    try:
        factory = method.load()
    except Exception as error:
        raise InputError(f"{name}: cannot be imported: {located(error, method.target)}") from error
    if not isinstance(factory, Configurable):
        return None
    try:
        return factory.config(preset)
    except ValueError as error:
        raise InputError(str(error)) from error


def configured(name: str, preset: str, changes: Mapping[str, Any] | Changes) -> Any:
    """The configuration that a preset means to a method, with `changes`.

    Raises:
        InputError: the method offers no configuration, or the configuration refuses a change.
    """
    config = offered(name, preset)
    if config is None:
        key = next(iter(dict(changes)), "")
        raise InputError(f"{name}: offers no configuration, and so has no key {key!r} (docs/plugin.md)")
    try:
        return apply_overrides(config, current_fields(config, changes), of=name)
    except ValueError as error:  # A dataclass of someone else's may not know our kind of it.
        raise InputError(str(error)) from error


def make_avatar(
    factory: Callable[..., Any], capture: Capture, *, of: str, seed: int, preset: str, changes: Mapping[str, Any]
) -> Any:
    """Call a factory; `changes` in the configuration that `preset` means to the method `of`.

    Raises:
        InputError: as `configured`.
    """
    if not changes:
        return factory(capture, seed=seed, preset=preset)
    return factory(capture, seed=seed, preset=preset, config=configured(of, preset, changes))


def current_fields(config: Any, changes: Mapping[str, Any] | Changes) -> dict[str, Any]:
    """Changes whose old keys (`benchmarks.aliases`) are replaced by today's, where the configuration has these."""
    fields = flat(config)
    return {OLD_FIELDS[key] if OLD_FIELDS.get(key) in fields else key: value for key, value in dict(changes).items()}


def located(error: BaseException, target: str) -> str:
    """An error with file and line: the last of the method's own files on its way, or where it was raised."""
    message = f"{type(error).__name__}: {error}"
    reached = traceback.extract_tb(error.__traceback__)
    spec = find_spec_of(target)
    own = "" if spec is None or spec.origin is None else str(Path(spec.origin).parent)
    places = [place for place in reached if own and place.filename.startswith(own)] or reached
    if isinstance(error, SyntaxError) or not places:  # It says itself where it is.
        return message
    path = Path(places[-1].filename)
    return f"{message} ({path.parent.name}/{path.name}:{places[-1].lineno})"


def find_spec_of(target: str) -> ModuleSpec | None:
    """The module of `package.module:function`, None where there is none."""
    try:
        return find_spec(target.partition(":")[0])
    except (ImportError, ValueError):
        return None


@cache
def code_version(method: str) -> str:
    """SHA-256 over everything of ours that decides a cell's outcome, and all sources of a third party's method.

    Of `baselines`, only what a method of ours imports decides its outcome; a third party's may import anything.
    """
    source = find_method(method)
    baselines = sorted(baseline_sources(source.target)) if source.is_ours else [_package_folder("baselines")]
    digest = hashlib.sha256(hash_sources(_package_folder("ash"), *baselines, Path(__file__).parent).encode())
    if not source.is_ours:
        digest.update(f"{source.target} {source.distribution}".encode())
        digest.update(_sources_of(source).encode())
    return digest.hexdigest()[:16]


def baseline_sources(target: str) -> set[Path]:
    """The modules of `baselines` that a method of ours is made of: its own, and those it imports through each other."""
    folder, found, todo = _package_folder("baselines"), set(), [target.partition(":")[0]]
    while todo:
        package, _, name = todo.pop().partition(".")
        path = folder / f"{name}.py"
        if package == "baselines" and path not in found and path.is_file():
            found.add(path)
            todo += _imported_modules(path)
    return found


def _sources_of(method: Method) -> str:
    spec = find_spec_of(method.target)
    if method.target.split(".")[0] in OUR_PACKAGES and spec is not None and spec.origin is not None:
        return hash_sources(Path(spec.origin))  # A planted defect, say: the rest of it is hashed already.
    return plugin_hash(method.target, method.distribution.rpartition(" ")[0])


def _package_folder(package: str) -> Path:
    spec = find_spec(package)
    if spec is None or spec.origin is None:
        raise InputError(f"the package {package} is not importable: install ash-bench again")
    return Path(spec.origin).parent  # Not its search locations: an editable install lists an empty folder among them.


def plugin_hash(target: str, distribution_name: str) -> str:
    """SHA-256 over the sources of a method: its distribution's, its package's, or its file's with what lies beside it.

    `target` is `package.module:function`; `distribution_name` is that of the installed distribution which brought it,
    empty for a factory that is named by its path. Of an editable installation every source below its project counts.
    """
    files = set(package_files(target))
    if distribution_name:
        with contextlib.suppress(PackageNotFoundError):
            files |= distribution_files(distribution(distribution_name))
    digest = hashlib.sha256()
    for path in sorted(path.resolve() for path in files):
        content = path.read_bytes()
        digest.update(f"{path.name} {len(content)}\n".encode() + content)
    return digest.hexdigest()


def distribution_files(installed: Distribution) -> set[Path]:
    """The sources that a distribution installed, or of an editable one all below its project's folder."""
    project = editable_folder(installed)
    if project is not None:
        return sources_below(project)
    listed = [Path(str(installed.locate_file(name))) for name in installed.files or ()]
    return {path for path in listed if path.suffix in SUFFIXES and path.is_file()}


def editable_folder(installed: Distribution) -> Path | None:
    """Where the project of an editable installation lies (PEP 610)."""
    try:
        described = json.loads(installed.read_text("direct_url.json") or "{}")
        if described.get("dir_info", {}).get("editable"):
            return Path(unquote(urlsplit(described["url"]).path))
    except (AttributeError, KeyError, TypeError, ValueError):
        return None  # Not written by pip; what the module's own package holds is hashed all the same.
    return None


def package_files(target: str) -> set[Path]:
    """The sources of the top-level package that a target lies in; of a single file, those beside it that it imports."""
    top = target.partition(":")[0].split(".")[0]
    spec = find_spec(top)
    if spec is None:
        return set()
    if spec.submodule_search_locations:
        folders = [Path(folder) for folder in spec.submodule_search_locations]
        return {path for folder in folders for path in sources_below(folder)}
    return imported_from(Path(spec.origin)) if spec.origin and Path(spec.origin).is_file() else set()


def sources_below(folder: Path) -> set[Path]:
    """Every file of source below a folder, without environments, caches and what a build left."""
    sources = set()
    for place, folders, names in os.walk(folder):
        here = Path(place)
        folders[:] = [
            name
            for name in folders
            if name not in NOT_SOURCES and name[0] != "." and not (here / name / "pyvenv.cfg").exists()
        ]
        sources |= {here / name for name in names if Path(name).suffix in SUFFIXES and (here / name).is_file()}
    return sources


def imported_from(module: Path) -> set[Path]:
    """A file, and the modules and packages in its folder that it imports, directly or through each other."""
    sources, todo = {module}, [module]
    while todo:
        for name in _imports(todo.pop()):
            single, package = module.parent / f"{name}.py", module.parent / name
            new = {single} if single.is_file() else sources_below(package) if package.is_dir() else set()
            todo += [path for path in new - sources if path.suffix == ".py"]
            sources |= new
    return sources


def _imports(path: Path) -> set[str]:
    """Top-level names that a file imports, wherever it does."""
    return {name.split(".")[0] for name in _imported_modules(path)}


def _imported_modules(path: Path) -> set[str]:
    """What a file imports, wherever it does: modules, and names in them, which may be modules, too."""
    try:
        tree = ast.parse(path.read_bytes())
    except (SyntaxError, ValueError):
        return set()  # Its import will say so.
    names: set[str] = set()
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            names |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            inside = {f"{node.module}.{alias.name}" if node.module else alias.name for alias in node.names}
            names |= inside | ({node.module} if node.module else set())
    return names
