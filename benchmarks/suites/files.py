"""Reads a suite from its file, ours (beside this module) or a user's; every error names file, line and key.

    about = "is width needed?"
    scenes = ["tight", { of = "tight", outfit.swing = 0.8, methods = ["ash"] }, { capture = "data/mine" }]
    size = "quick"               # of scenes; `size` in a scene's table overrules it
    methods = ["ash", { of = "ash", model.width = 8 }, { of = "my_package.avatar:mine", name = "mine" }]
    preset = "cpu"               # of methods; `preset` in a method's table overrules it
    seeds = 3                    # of the training
    subjects = 8                 # captures of so many people, see `synth.person.cast`
    stresses.cameras = [25, 50]  # axis = severities, see `benchmarks.suites.stress`
    limit_minutes = 60           # of one cell, and limit_mb
    cell_minutes = 2.5           # what one cell takes, for estimates

What the report's own table shows stands in `[[table]]`, see `benchmarks.suites.tables`.
A method's table may have a `title` for reports: `{ of = "ash", name = "narrow", title = "Half the width", ... }`.
A method `{ of = "predictions:DIR", name = "mine" }` is pictures that were rendered elsewhere (docs/predictions.md).
`[[methods]]` and `[[scenes]]` as tables of their own mean the same; all further keys of such a table are replacements
in the scene or in the method's configuration. Of a scene that names some of the methods, only those run on it.
"""

import tomllib
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import fields, replace
from pathlib import Path
from typing import Any

import tomlkit
from tomlkit.exceptions import NonExistentKey, TOMLKitError
from tomlkit.items import AbstractTable, Table

from ash.capture.manifest import read_manifest
from ash.fields import WRITTEN, Changes, for_json, suggest
from ash.files import InputError, hash_of, open_regular
from benchmarks.aliases import OLD_SIZES, OLD_SUITES
from benchmarks.cell.registry import brought_folder, configured, find_method, methods
from benchmarks.suites.captures import recipe_of, subject_of
from benchmarks.suites.stress import Stress
from benchmarks.suites.suites import AS_GIVEN, MethodSpec, SceneSpec, Suite, people_of_one, varied_name
from benchmarks.suites.tables import TableSpec, tables_of

FOLDER = Path(__file__).parent
LARGEST = 1 << 20  # bytes of a suite's file
LONGEST_TITLE = 60  # characters of a method's title
MARK = "ba5e11ne"  # Found again where it was put; no file has it.
Place = tuple[str | int, ...]  # A key of the file, from the top.
PLAIN: dict[str, type] = {
    "about": str,
    "size": str,
    "preset": str,
    "seeds": int,
    "subjects": int,
    "cell_minutes": float,
    "limit_minutes": float,
    "limit_mb": int,
}


def suite_files() -> dict[str, Path]:
    """Our own suites by name."""
    return {path.stem: path for path in sorted(FOLDER.glob("*.toml"))}


def our_rows() -> frozenset[tuple[str, str, str]]:
    """Name, factory and hash of the changes of every varied method in our own suites."""
    names = set()
    for path in suite_files().values():
        for row in tomllib.loads(path.read_text())["methods"]:  # tomlkit takes seconds for all.
            if isinstance(row, dict):
                changes = _dotted({key: value for key, value in row.items() if key not in METHOD_KEYS})
                name = row.get("name") or varied_name(row["of"], changes)
                names.add((name, row["of"], hash_of(for_json(changes))))
    return frozenset(names)


def methods_known() -> frozenset[str]:
    """Every name that a row of methods may have without a definition of its own: installed, or varied in our suites."""
    return frozenset((*methods(), *(name for name, _, _ in our_rows())))


def find_suite(name: str | Path) -> Suite:
    """A suite of ours by name, or anyone's by its file."""
    return read_suite(suite_file(name))


def suite_file(name: str | Path) -> Path:
    """The file of a suite of ours, by today's or an old name, or anyone's file itself.

    Raises:
        InputError: it is neither.
    """
    suites = suite_files()
    path = suites.get(OLD_SUITES.get(str(name), str(name)), Path(name))
    if path.suffix != ".toml":
        raise InputError(f"unknown suite {str(name)!r}, {suggest(str(name), (*suites, 'FILE.toml'))}")
    return path


def read_suite(path: Path) -> Suite:
    """The suite that a file describes; its name is the file's.

    Raises:
        InputError: names file, line and key.
    """
    text, content = _parsed(path)
    return _Reader(path, text).suite(content)


def read_tables(path: Path) -> tuple[tuple[TableSpec, ...], frozenset[str]]:
    """The tables of a file, a suite's or one of its own, and the suite's rows and scenes, which they may name.

    Raises:
        InputError: it has no table, or something in it is wrong; names the file and the key.
    """
    _, content = _parsed(path)
    if "methods" in content:
        suite = read_suite(path)
        names = [row.name for row in suite.methods] + [scene.name for scene in suite.scenes]
        tables, own = suite.table, frozenset(names)
    elif unknown := [key for key in content if key != "table"]:
        raise InputError(f"{path}: unknown key {unknown[0]!r}, {suggest(unknown[0], ('table',))}")
    else:
        tables, own = tables_of(content.get("table", []), place=str(path)), frozenset[str]()
    if not tables:
        raise InputError(f"{path}: expected a [[table]] with `columns`")
    return tables, own


def _parsed(path: Path) -> tuple[str, dict[str, Any]]:
    """The text of a file, and what it says."""
    try:
        with open_regular(path, most=LARGEST) as file:
            text = file.read().decode()
        content: dict[str, Any] = tomlkit.parse(text).unwrap()
    except UnicodeDecodeError as error:
        raise InputError(f"{path}: expected TOML in UTF-8 ({error})") from error
    except TOMLKitError as error:  # Not every kind knows its line.
        raise InputError(f"{path}:{getattr(error, 'line', 1)}: not valid TOML ({error})") from error
    return text, content


SUITE_KEYS = tuple(field.name for field in fields(Suite) if field.name not in ("name", "validation"))
REQUIRED = ("scenes", "methods", "preset")
SCENE_KEYS, METHOD_KEYS = ("name", "of", "size", "capture"), ("name", "of", "preset", "title")


class _Reader:
    """Checks the content of one file; knows where in the file a key stands."""

    def __init__(self, path: Path, text: str) -> None:
        self.path, self.text = path, text

    def suite(self, content: dict[str, Any]) -> Suite:
        """The whole file."""
        for key in content:
            if key not in SUITE_KEYS:
                raise self.error((key,), f"unknown key {key!r}, {suggest(key, SUITE_KEYS)}")
        for key in REQUIRED:
            if key not in content:
                raise InputError(f"{self.path}: expected the key {key!r}")
        plain = {"about": "", "size": "quick", **content}
        plain = {key: self.checked(key, value) for key, value in plain.items() if key in PLAIN}
        plain["size"] = OLD_SIZES.get(plain["size"], plain["size"])
        size, preset = plain["size"], plain["preset"]
        scenes = tuple(self.scene(index, row, size) for index, row in enumerate(self.rows(content, "scenes")))
        methods = tuple(self.method(index, row, preset) for index, row in enumerate(self.rows(content, "methods")))
        stresses = tuple(self.stresses(content.get("stresses", {})))
        try:
            tables = tables_of(content.get("table", []), place="table")
        except InputError as error:
            raise self.error(("table",), str(error)) from error
        named = {row.method for table in tables for group in table.rows for row in group if row.method}
        known = tuple(row.name for row in methods)
        if unknown := sorted(named - {*known, *methods_known()} if named - set(known) else ()):
            raise self.error(("table",), f"table: no row {unknown[0]!r}, {suggest(unknown[0], known)}")
        try:
            return Suite(name=self.path.stem, scenes=scenes, methods=methods, stresses=stresses, table=tables, **plain)
        except InputError as error:
            keys = [key for key in content if str(error).startswith((f"{key}:", f"two {key}"))]
            raise self.error(tuple(keys), str(error)) from error

    def rows(self, content: dict[str, Any], key: str) -> list[dict[str, Any]]:
        """Scenes or methods: names, which stand for themselves, and tables."""
        rows = content[key]
        if not isinstance(rows, list) or not all(isinstance(row, str | dict) for row in rows):
            raise self.error((key,), f"{key}: expected a list of names and tables, got {rows!r}")
        return [{"of": row} if isinstance(row, str) else row for row in rows]

    def scene(self, index: int, row: dict[str, Any], size: str) -> SceneSpec:
        """One row of scenes."""
        from benchmarks.suites.scenes import scene_of

        place: Place = ("scenes", index)
        methods = row.get("methods", [])
        if not isinstance(methods, list) or not all(isinstance(name, str) for name in methods):
            raise self.error((*place, "methods"), f"methods: expected a list of names, got {methods!r}")
        known, changes = self.split({key: row[key] for key in row if key != "methods"}, place, SCENE_KEYS)
        if "capture" in known:
            if changes or set(known) - {"capture", "name"}:
                raise self.error(
                    place, "a finished capture is taken as it is: expected no key but capture, name and methods"
                )
            spec = self.located(place, lambda: given_capture(Path(known["capture"]), name=known.get("name", "")))
            return replace(spec, methods=tuple(methods))
        of, own = known["of"], known.get("size", "")
        self.located(place, lambda: scene_of(of, size=own or size))
        self.each(place, changes, lambda some: scene_of(of, size=own or size, changes=some))
        name = known.get("name") or varied_name(of, changes)
        return SceneSpec(name=name, of=of, size=own, changes=changes, methods=tuple(methods))

    def method(self, index: int, row: dict[str, Any], preset: str) -> MethodSpec:
        """One row of methods; its configuration is made once, so that it is refused here and not in its cells."""
        place: Place = ("methods", index)
        known, changes = self.split(row, place, METHOD_KEYS)
        of, own, name, title = known["of"], known.get("preset", ""), known.get("name", ""), known.get("title", "")
        if not title.isprintable() or len(title) > LONGEST_TITLE:
            raise self.error((*place, "title"), f"title: expected at most {LONGEST_TITLE} printable characters")
        if brought_folder(of) is not None:  # Pictures that were rendered elsewhere.
            if changes or own or not name:
                raise self.error(place, "pictures are taken as they are: expected the keys of, name and perhaps title")
            own = AS_GIVEN
        else:
            self.located((*place, "of"), lambda: find_method(of))
            self.each(place, changes, lambda some: configured(of, own or preset, some))
            name = name or varied_name(of, changes + ((("preset", own),) if own else ()))
            if title and name == of and find_method(of).is_ours:
                raise self.error((*place, "title"), f"title: {of} has one; expected it beside a name of the row's own")
        return self.located(place, lambda: MethodSpec(name=name, of=of, preset=own, changes=changes, title=title))  # type: ignore[no-any-return]

    def stresses(self, table: Any) -> Iterator[Stress]:
        """Every step of every axis."""
        if not isinstance(table, dict):
            raise self.error(("stresses",), f"stresses: expected axes with lists of severities, got {table!r}")
        for axis, severities in table.items():
            place = ("stresses", axis)
            if not isinstance(severities, list) or not all(type(step) in (int, float) for step in severities):
                raise self.error(place, f"stresses.{axis}: expected a list of numbers, got {severities!r}")
            for severity in severities:
                yield self.located(place, lambda axis=axis, s=severity: Stress(axis=axis, severity=float(s)))

    def split(self, row: dict[str, Any], place: Place, own: tuple[str, ...]) -> tuple[dict[str, str], Changes]:
        """What says which row it is (`of`, or `capture` of a scene, is among it), and what is replaced in it."""
        known = {key: value for key, value in row.items() if key in own}
        for key, value in known.items():
            if not isinstance(value, str) or not value:
                raise self.error((*place, key), f"{key}: expected a text, got {value!r}")
        for key in ("seed", "subject"):
            if key in row:
                raise self.error((*place, key), f"{key}: a row has none of its own, the suite's `{key}s` counts them")
        if not known.keys() & {"of", "capture"}:
            raise self.error(place, f"{place[0]}: expected the key 'of', what this row is or is a variant of")
        return known, _dotted({key: value for key, value in row.items() if key not in own})

    def each(self, place: Place, changes: Changes, make: Callable[[Changes], Any]) -> None:
        """Try the changes of a row; where they are refused, name the line of the first that is refused by itself."""
        if not changes:
            return
        try:
            make(changes)
        except InputError as error:
            for key, value in changes:
                try:
                    make(((key, value),))
                except InputError as single:
                    raise self.error((*place, *key.split(".")), str(single)) from single
            raise self.error(place, str(error)) from error

    def checked(self, key: str, value: Any) -> Any:
        """A value of the type that the suite has there."""
        kind = PLAIN[key]
        fits = isinstance(value, int | float) if kind is float else isinstance(value, kind)
        if not fits or isinstance(value, bool):
            raise self.error((key,), f"{key}: expected {WRITTEN[kind]}, got {value!r}")
        return kind(value)

    def located(self, place: Place, make: Callable[[], Any]) -> Any:
        """What `make` makes; its errors say where in the file."""
        try:
            return make()
        except InputError as error:
            raise self.error(place, str(error)) from error

    def error(self, place: Place, message: str) -> InputError:
        """An error at a key of the file."""
        return InputError(f"{self.path}:{line_of(self.text, place)}: {message}")


def given_capture(folder: Path, *, name: str = "") -> SceneSpec:
    """A finished capture as a row of a suite; it is called as its scene is, where no name is given."""
    manifest = read_manifest(folder)
    return SceneSpec(
        name=name or manifest.scene,
        size=manifest.size or AS_GIVEN,
        folder=folder,
        subject=subject_of(manifest),
        recipe=recipe_of(manifest),
    )


def given_captures(folders: Sequence[Path]) -> tuple[SceneSpec, ...]:
    """Finished captures as rows, called as their scenes are: those that differ in the subject alone are people of one.

    Others that are called alike are called as their folders are.
    """
    rows = [given_capture(folder) for folder in folders]
    return tuple(
        row
        if people_of_one([other for other in rows if other.name == row.name])
        else replace(row, name=folder.resolve().name)
        for row, folder in zip(rows, folders, strict=True)
    )


def _dotted(table: Mapping[str, Any]) -> Changes:
    flat: dict[str, Any] = {}
    for key, value in table.items():
        inner = _dotted(value) if isinstance(value, dict) else None
        flat |= {key: value} if inner is None else {f"{key}.{name}": each for name, each in inner}
    return tuple((key, tuple(value) if isinstance(value, list) else value) for key, value in sorted(flat.items()))


def line_of(text: str, place: Place) -> int:
    """The line of a key in a TOML text, or of the innermost table around it that is there. Counted from one."""
    document = tomlkit.parse(text)
    item: Any = document
    holder: Any = None
    name: str | int = 0
    for part in place:
        inner = _inner(item, part)
        if inner is None:
            break
        holder, name, item = item, part, inner
    if item is document:
        return 1
    if isinstance(item, Table) and not item.is_super_table():
        item.comment(MARK)  # Beside its header.
    else:
        holder[name] = MARK
    marked = (number for number, line in enumerate(tomlkit.dumps(document).splitlines(), 1) if MARK in line)
    return next(marked, 1)


def _inner(item: Any, part: str | int) -> Any:
    try:
        if isinstance(part, int):
            return item[part]
        container = item.value if isinstance(item, AbstractTable) else item
        return container.item(part)
    except (KeyError, IndexError, AttributeError, TypeError, NonExistentKey):
        return None
