"""Which files a third party's method consists of, so that a changed method is never served its old score."""

import ast
import contextlib
import hashlib
import json
import os
from importlib.metadata import Distribution, PackageNotFoundError, distribution
from importlib.util import find_spec
from pathlib import Path
from urllib.parse import unquote, urlsplit

SUFFIXES = frozenset({".py", ".pyi", ".so", ".pyd", ".cpp", ".cc", ".cu", ".c", ".h", ".hpp", ".cuh", ".inc", ".toml"})
NOT_SOURCES = frozenset({"build", "dist", "node_modules", "site-packages", "__pycache__"})


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


def distribution_files(found: Distribution) -> set[Path]:
    """The sources that a distribution installed, or of an editable one all below its project's folder."""
    project = editable_folder(found)
    if project is not None:
        return sources_below(project)
    listed = [Path(str(found.locate_file(name))) for name in found.files or ()]
    return {path for path in listed if path.suffix in SUFFIXES and path.is_file()}


def editable_folder(found: Distribution) -> Path | None:
    """Where the project of an editable installation lies (PEP 610)."""
    try:
        described = json.loads(found.read_text("direct_url.json") or "{}")
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
    found = set()
    for place, folders, names in os.walk(folder):
        here = Path(place)
        folders[:] = [
            name
            for name in folders
            if name not in NOT_SOURCES and name[0] != "." and not (here / name / "pyvenv.cfg").exists()
        ]
        found |= {here / name for name in names if Path(name).suffix in SUFFIXES and (here / name).is_file()}
    return found


def imported_from(module: Path) -> set[Path]:
    """A file, and the modules and packages in its folder that it imports, directly or through each other."""
    found, todo = {module}, [module]
    while todo:
        for name in _imports(todo.pop()):
            single, package = module.parent / f"{name}.py", module.parent / name
            new = {single} if single.is_file() else sources_below(package) if package.is_dir() else set()
            todo += [path for path in new - found if path.suffix == ".py"]
            found |= new
    return found


def _imports(path: Path) -> set[str]:
    """Top-level names that a file imports, wherever it does."""
    try:
        tree = ast.parse(path.read_bytes())
    except (SyntaxError, ValueError):
        return set()  # Its import will say so.
    names: set[str] = set()
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            names |= {alias.name.split(".")[0] for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            names |= {node.module.split(".")[0]} if node.module else {alias.name for alias in node.names}
    return names
