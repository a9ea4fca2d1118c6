"""A suite's file: ours and a user's, and errors that name file, line and key."""

from dataclasses import replace
from pathlib import Path

import pytest
from helpers import fakes

from ash.capture.manifest import read_manifest
from ash.files import InputError, require_plain
from benchmarks.analysis.style import STYLES, is_ours, style_of, titles_of, user_rows
from benchmarks.cell.registry import WRONG_BY_MM, is_oracle
from benchmarks.cell.schema import write_config
from benchmarks.suites.captures import described
from benchmarks.suites.files import find_suite, given_captures, line_of, methods_known, read_suite, suite_files
from benchmarks.suites.runs import Run, cell_for, read_run, write_run
from benchmarks.suites.suites import SceneSpec, varied_name

GOOD = """\
about = "is width needed?"
scenes = ["tight", { of = "tight", name = "tight_swing", outfit.swing = 0.8 }]
size = "ci"
methods = [
    "ash",
    { of = "ash", model.width = 4 },
    { of = "ddc", name = "mesh", preset = "brief", texture = 256 },
]
preset = "ci"
seeds = 2
limit_minutes = 30
stresses.cameras = [25, 50]
"""
TABLES = """\
scenes = ["mannequin"]
preset = "ci"
[[methods]]
of = "ash"
[[methods]]
of = "ash"
model.width = 4
"""


def written(folder: Path, text: str) -> Path:
    path = folder / "mine.toml"
    path.write_text(text)
    return path


def test_a_file_says_scenes_methods_and_what_is_replaced_in_them(tmp_path: Path) -> None:
    suite = read_suite(written(tmp_path, GOOD))
    assert (suite.name, suite.seeds, suite.limit_minutes, suite.limit_mb) == ("mine", 2, 30.0, 8192)
    assert suite.scenes[1] == SceneSpec(name="tight_swing", of="tight", changes=(("outfit.swing", 0.8),))
    assert [row.name for row in suite.methods] == ["ash", "ash+width=4", "mesh"]
    cells = list(suite.cells)
    assert len(cells) == 2 * 2 * 3 * (1 + 2)
    assert (cells[1].method, cells[1].factory, cells[1].changes) == ("ash+width=4", "ash", (("model.width", 4),))
    assert (cells[0].factory, cells[2].preset) == ("", "brief")
    assert read_suite(written(tmp_path, TABLES)).methods == suite.methods[:2], "tables of their own mean the same"


def test_a_scene_may_name_the_methods_that_run_on_it(tmp_path: Path) -> None:
    some = GOOD.replace("outfit.swing = 0.8", "outfit.swing = 0.8, methods = ['mesh', 'ash']")
    suite = read_suite(written(tmp_path, some))
    assert suite.scenes[1].changes == (("outfit.swing", 0.8),)
    ran = {
        scene: [cell.method for cell in suite.cells if cell.capture.scene == scene]
        for scene in ("tight", "tight_swing")
    }
    assert ran["tight"] == ["ash", "ash+width=4", "mesh"] * 3 * 2
    assert ran["tight_swing"] == ["ash", "mesh"] * 3 * 2, "in the suite's order, under every stress"
    asked = suite.narrowed(methods=("ash+width=4",), seeds=1)
    assert [cell.capture.scene for cell in asked.cells] == ["tight", "tight_swing"] * 3, "who asks gets what was asked"
    assert len(list(suite.narrowed(scenes=suite.scenes[1:], seeds=1).cells)) == 2 * 3
    capture = fakes.write_capture(tmp_path / "boxes")
    given = GOOD.replace('"tight",', f"{{ capture = {str(capture)!r}, methods = ['ash'] }},", 1)
    assert read_suite(written(tmp_path, given)).scenes[0].methods == ("ash",)


def test_people_to_choose_by_are_numbered_from_100_on(tmp_path: Path) -> None:
    suite = read_suite(written(tmp_path, GOOD)).narrowed(subjects=2, validation=True)
    assert {capture.subject for capture in suite.captures} == {100, 101}
    assert {capture.subject for capture in suite.narrowed(validation=False).captures} == {0, 1}


def test_a_capture_that_is_there_is_a_scene(tmp_path: Path) -> None:
    capture = fakes.write_capture(tmp_path / "mine")
    suite = read_suite(written(tmp_path, GOOD.replace('"tight",', f"{{ capture = {str(capture)!r} }},", 1)))
    assert suite.captures[0].folder == capture and suite.captures[0].scene == "boxes"
    assert [row.name for row in given_captures([capture, capture])] == ["mine", "mine"]


def test_captures_that_differ_in_the_subject_alone_are_people_of_one_scene(tmp_path: Path) -> None:
    first, second, brighter = (fakes.write_capture(tmp_path / name) for name in ("first", "second", "brighter"))
    for folder, subject, light in ((first, 0, 1.0), (second, 4, 1.0), (brighter, 5, 2.0)):
        replace(read_manifest(folder), parameters={"subject": subject, "light": light}).write(folder)
    names = [(row.name, row.subject) for row in given_captures([first, second])]
    assert names == [("boxes", 0), ("boxes", 4)]
    assert [row.name for row in given_captures([first, second, brighter])] == ["first", "second", "brighter"]

    captures = f"{{ capture = {str(first)!r} }}, {{ capture = {str(second)!r}, methods = ['mesh'] }}"
    suite = read_suite(written(tmp_path, GOOD.replace('"tight",', captures + ",", 1)))
    cells = [cell for cell in suite.cells if cell.capture.scene == "boxes" and not cell.seed]
    assert {(cell.capture.subject, cell.method) for cell in cells if not cell.capture.stress} == {
        (0, "ash"),
        (0, "ash+width=4"),
        (0, "mesh"),
        (4, "mesh"),
    }
    with pytest.raises(InputError, match="two scenes are called 'boxes'"):
        read_suite(written(tmp_path, GOOD.replace('"tight",', captures.replace("second", "brighter") + ",", 1)))


@pytest.mark.parametrize(
    ("before", "after", "line", "message"),
    [
        ("seeds", "sedes", 10, "unknown key 'sedes', did you mean seeds"),
        ("seeds = 2", "seeds = 0", 10, "seeds: expected 1 to 1000"),
        ("seeds = 2", "subjects = 0", 10, "subjects: expected 1 to 100, got 0"),
        ("seeds = 2", "subjects = 101", 10, "those from 100 on are for validation"),
        ("seeds = 2", 'seeds = "two"', 10, "seeds: expected a whole number, got 'two'"),
        ("seeds = 2", "seeds = = 2", 10, "not valid TOML"),
        ('"tight",', '"tihgt",', 2, "unknown scene 'tihgt', did you mean tight"),
        ("outfit.swing", "outfit.swnig", 2, "unknown key 'outfit.swnig', did you mean outfit.swing"),
        ("0.8", "8", 2, "swing is 8.0, expected 0 to 1"),
        ('"ci"\nmethods', '"huge"\nmethods', 2, "unknown size 'huge', expected one of ci, factor, quick, long"),
        ('    "ash"', '    "ahs"', 5, "unknown method 'ahs', did you mean ash"),
        ("model.width = 4", "model.width = 'x'", 6, "model.width: expected a whole number, got 'x'"),
        ("model.width = 4", "width = 4", 6, "unknown key 'width', did you mean model.width"),
        ("texture = 256", "texture = 256, seed = 3", 7, "seed: a row has none of its own"),
        (
            "outfit.swing = 0.8",
            "subject = 3",
            2,
            "subject: a row has none of its own, the suite's `subjects` counts them",
        ),
        (
            "swing = 0.8",
            "swing = 0.8, methods = ['mehs']",
            2,
            "tight_swing asks for the method 'mehs', did you mean mesh",
        ),
        ("swing = 0.8", "swing = 0.8, methods = 'ash'", 2, "methods: expected a list of names, got 'ash'"),
        ('of = "ddc"', 'of = "nearest"', 7, "nearest: offers no configuration, and so has no key 'texture'"),
        ('preset = "brief"', 'preset = "chaep"', 7, "preset: expected one of ci, brief"),
        ('name = "mesh"', 'name = "ash"', 4, "two methods are called 'ash'"),
        ('name = "mesh"', 'name = "ash_truth"', 7, "expected a name that is no oracle's"),
        ('of = "ddc"', 'of = "ddc_truth"', 7, "expected a name that begins with 'ddc_truth', an oracle"),
        ('name = "mesh"', 'title = "Mine", name = "ddc"', 7, "title: ddc has one"),
        ('"mesh"', '"mesh", title = "a\\u001b[2J"', 7, "title: expected at most 60 printable characters"),
        ("cameras = [", "camreas = [", 12, "unknown stress axis 'camreas', did you mean cameras"),
        ("[25, 50]", "[0]", 12, "expected a severity above zero"),
        ("[25, 50]", "25", 12, "expected a list of numbers"),
        ("30\n", "0\n", 11, "limit_minutes"),
    ],
)
def test_errors_name_file_line_and_key(before: str, after: str, line: int, message: str, tmp_path: Path) -> None:
    assert before in GOOD
    path = written(tmp_path, GOOD.replace(before, after, 1))
    with pytest.raises(InputError) as refusal:
        read_suite(path)
    assert str(refusal.value).startswith(f"{path}:{line}: "), refusal.value
    assert message in str(refusal.value) and "\n" not in str(refusal.value)


def test_lines_are_found_in_lists_tables_and_dotted_keys() -> None:
    assert line_of(GOOD, ("methods", 2, "texture")) == 7
    assert line_of(TABLES, ("methods", 1, "model", "width")) == 7
    assert line_of(TABLES, ("methods", 1)) == 5
    assert line_of(TABLES, ("nothing",)) == 1


def test_an_oracle_is_told_by_its_rows_name(tmp_path: Path) -> None:
    rows = "{ of = 'ash_truth', name = 'ash_truth, narrow', model.width = 4 }, { of = 'ash_truth', model.width = 4 }"
    suite = read_suite(written(tmp_path, f"scenes = ['loose']\nmethods = [{rows}]\npreset = 'ci'\n"))
    assert all(is_oracle(method.name) for method in suite.methods)
    crossed = "scenes = ['loose']\nmethods = [{ of = 'ddc_truth', name = 'ash_truth' }]\npreset = 'ci'\n"
    with pytest.raises(InputError, match="expected a name that begins with 'ddc_truth', an oracle"):
        read_suite(written(tmp_path, crossed))


def test_our_suites_are_such_files_and_their_rows_ours(tmp_path: Path) -> None:
    """Every row has an identity, and none is taken for a user's own."""
    ours = "quick table factors stability template switches speed paper offline ci"
    assert set(suite_files()) >= set(ours.split())
    capture = fakes.write_capture(tmp_path / "mine")
    for name in suite_files():
        suite = find_suite(name)
        cells = list(suite.cells)
        assert suite.name == name and suite.about and cells
        assert [row.name for row in suite.methods if not is_ours(row.name)] == [], name
        rows = [cell_for(cell, capture, tmp_path).config for cell in cells[: len(suite.methods)]]
        assert len({row.key for row in rows}) == len(suite.methods)
        assert not user_rows(rows)
    assert not is_ours("mine")
    template = {row.name for row in find_suite("template").methods}
    assert {method for row in WRONG_BY_MM.values() for method in row} <= template


def test_every_row_of_ours_has_a_style() -> None:
    assert sorted(methods_known() - STYLES.keys()) == []
    assert style_of("ash_16mm").title == "ASH, surface 16 mm off"


def test_a_users_row_does_not_take_our_title(tmp_path: Path) -> None:
    capture = fakes.write_capture(tmp_path / "mine")
    rows = '"ash", { of = "ash", name = "refined", model.width = 12 }, { of = "ash", name = "wo_mot", model.width = 4 }'
    text = f'scenes = ["tight"]\npreset = "ci"\nmethods = [{rows}]\n'
    suite = read_suite(written(tmp_path, text))
    configs = [cell_for(cell, capture, tmp_path).config for cell in suite.cells]
    with titles_of(configs):
        assert [style_of(config.method).title for config in configs] == ["ASH", "refined", "wo_mot"]
        assert [is_ours(config.method) for config in configs] == [True, False, False]
    assert style_of("refined").title != "refined", "outside of the report the title is ours again"


def test_a_row_has_the_title_that_its_suite_gives(tmp_path: Path) -> None:
    capture = fakes.write_capture(tmp_path / "mine")
    rows = """[
        "ash",
        { of = "ash", name = "refined", title = "Half the width", model.width = 12 },
        { of = "ash", name = "narrow", title = "ASH", model.width = 4 },
    ]"""
    suite = read_suite(written(tmp_path, f'preset = "ci"\nscenes = ["tight"]\nmethods = {rows}'.replace("\n ", " ")))
    cells = tuple(cell_for(cell, capture, tmp_path) for cell in suite.cells)
    titles = {method.name: method.title for method in suite.methods if method.title}
    for cell in cells:
        write_config(cell)
    write_run(Run(folder=tmp_path, suite="mine", about="a", command="", cells=cells, titles=titles))
    run = read_run(tmp_path)
    with titles_of([cell.config for cell in run.cells], run.titles):
        assert [style_of(c.config.method).title for c in run.cells] == ["ASH", "Half the width", "ASH (narrow)"]


def test_every_subject_has_its_captures_and_subject_0_keeps_its_names(tmp_path: Path) -> None:
    suite = read_suite(written(tmp_path, GOOD.replace("seeds = 2", "subjects = 2")))
    names = [capture.name for capture in suite.captures if capture.stress is None]
    assert names == ["tight-ci-0", "tight_swing-ci-0", "tight-ci-0-subject1", "tight_swing-ci-0-subject1"]
    assert len(suite.captures) == 2 * 2 * (1 + 2)
    scene = described(suite.captures[-1])
    assert (scene.name, scene.subject, scene.outfit.swing) == ("tight_swing", 1, 0.8)
    assert suite.narrowed(subjects=1).captures == suite.captures[:6]
    given = replace(suite, scenes=(SceneSpec(name="mine", folder=tmp_path),), stresses=(), subjects=8)
    assert [capture.name for capture in given.captures] == ["mine-ci-0"]


def test_a_suite_is_narrowed_and_widened() -> None:
    suite = find_suite("quick").narrowed(methods=("ddc", "static"), seeds=5, preset=None)
    assert [row.name for row in suite.methods] == ["ddc", "static"]
    assert (suite.seeds, suite.preset) == (5, "cpu")
    with pytest.raises(InputError, match="unknown method 'nosuch'"):
        suite.narrowed(methods=("nosuch",))


def test_a_suite_is_narrowed_to_some_of_its_stresses() -> None:
    suite = find_suite("stability")
    some = suite.narrowed(stresses=("tracking", "cameras"))
    assert {each.axis for each in suite.stresses} > {each.axis for each in some.stresses} == {"tracking", "cameras"}
    assert len(some.captures) == 1 + 3 + 3 and len(suite.narrowed(stresses=()).captures) == len(suite.captures)
    with pytest.raises(InputError, match="suite stability: no stress 'traking', did you mean tracking"):
        suite.narrowed(stresses=("traking",))
    with pytest.raises(InputError, match="suite quick: no stress 'tracking', expected none"):
        find_suite("quick").narrowed(stresses=("tracking",))


def test_names_of_variants_are_fit_for_files() -> None:
    assert varied_name("ash", (("model.texels", 128), ("training.warmup", "none"))) == "ash+texels=128+warmup=none"
    assert varied_name("tight", (("rig.distortion", (0.1, 0, 0, 0)),)) == "tight+distortion=0.1_0_0_0"
    assert "/" not in varied_name("tight", (("rig.given", "../" * 99),))
    assert len(varied_name("tight", (("rig.given", "x" * 999),))) < 40
    shifts = {at: tuple((f"train.{clip}.shift", (at, 0.0)) for clip in range(9)) for at in (-0.5, 0.5)}
    many, others = (varied_name("lit", changes) for changes in shifts.values())
    assert require_plain(many, what="scene").startswith("lit+") and len(many) < 40 and many != others
