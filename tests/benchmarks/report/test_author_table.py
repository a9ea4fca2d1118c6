"""The table that an author asked for: what its file may say, the numbers, and LaTeX that compiles."""

import re
import shutil
import subprocess
from pathlib import Path

import pytest
from helpers.cells import people

from ash.files import InputError
from benchmarks.analysis.results import RunTables
from benchmarks.report import author_table
from benchmarks.report.page import write_tables
from benchmarks.suites.runs import Run, read_run, write_run
from benchmarks.suites.tables import tables_of

ASKED = {
    "caption": "Width & 100 % of it",
    "label": "tab:width",
    "rows": [
        ["ash"],
        ["wo_mot", {"method": "wo_disp", "title": "no_displacement"}],
        [{"title": "NA", "given": {"a": 30}}],
    ],
    "columns": [
        {"metric": "psnr", "split": "novel_view"},
        {"metric": "frame_ms", "unit": "s", "decimals": 3},
        {"given": "a", "title": "PSNR", "group": "Paper"},
    ],
    "reference": "ash",
    "form": "difference",
    "marks": ["bold", "underline", "colour"],
}
LEVELS = {"ash": (24.0, 25.0, 26.0, 27.0), "wo_mot": (20.1, 21.0, 22.0, 23.1), "wo_disp": (22.0, 23.1, 24.0, 25.1)}


def made(levels: dict[str, tuple[float, ...]], **changes: object) -> author_table.AuthorTable:
    (table,) = author_table.of_tables(RunTables(people(levels)), tables_of({**ASKED, **changes}, place="x.toml"))
    return table


def check_latex(text: str) -> None:
    """Braces and environments are balanced; every line of a tabular has as many cells as its head says."""
    plain = re.sub(r"(?<!\\)%.*", "", text)
    depth = 0
    for brace in re.findall(r"(?<!\\)[{}]", plain):
        depth += 1 if brace == "{" else -1
        assert depth >= 0
    assert depth == 0
    opened: list[str] = []
    for kind, name in re.findall(r"\\(begin|end)\{([\w*]+)\}", plain):
        if kind == "begin":
            opened.append(name)
        else:
            assert opened.pop() == name
    assert not opened
    for columns, body in re.findall(r"\\begin\{tabular\}\{@\{\}(\w+)@\{\}\}(.*?)\\end\{tabular\}", plain, re.DOTALL):
        for line in re.findall(r"^(?!\\)?.*(?=\\\\$)", body, re.MULTILINE):
            wide = sum(int(span) - 1 for span in re.findall(r"\\multicolumn\{(\d+)\}", line))
            assert len(re.findall(r"(?<!\\)&", line)) + 1 + wide == len(columns), line


def test_marks_and_differences_are_over_people_in_pairs() -> None:
    table = made(LEVELS)
    texts = table.shown.frame.iloc[:, 0].tolist()
    assert texts[0] == "25.50" and re.fullmatch(r"21\.55 \(\N{MINUS SIGN}3\.95 ± 0\.\d\d\)", texts[1])
    assert texts[3] == "n/a"
    assert table.shown.marks == {(0, 0): "best", (2, 0): "second"}
    assert table.shown.frame.iloc[0, 1] == "0.012" and table.shown.frame.iloc[3, 2] == "30.00"
    assert table.shown.frame.index.tolist() == ["ASH", "w/o mot.", "no_displacement", "NA"] and table.breaks == (1, 3)
    row = table.numbers.query("method == 'wo_mot' and metric == 'psnr'").iloc[0]
    assert row["difference"] == pytest.approx(-3.95) and row["difference_low"] < -3.95 < row["difference_high"]
    assert "Scene loose: 4 people, 1 seed each." in table.caption and "in pairs, over people" in table.caption
    assert "Bold and yellow: better than every other row" in table.caption
    tie = made({"ash": LEVELS["ash"], "wo_mot": LEVELS["ash"]}, marks=["bold"])
    assert tie.shown.marks == {} and "Bold" not in tie.caption and "No row is significantly better" in tie.caption


def test_one_value_has_no_mark_and_no_interval() -> None:
    table = made({name: values[:1] for name, values in LEVELS.items()})
    assert table.shown.marks == {} and "±" not in "".join(table.shown.frame.to_numpy().ravel())
    assert "One value per row" in table.caption and "Bold" not in table.caption


def test_the_caption_tells_the_region_of_a_column_that_has_a_title_of_its_own() -> None:
    plain = {"metric": "psnr", "split": "novel_view"}
    column = plain | {"region": "release_crop", "title": "PSNR"}
    assert made(LEVELS, columns=[column, column]).caption.count("PSNR: release crop.") == 1
    assert "crop" not in made(LEVELS, columns=[plain, plain | {"title": "PSNR"}]).caption


def test_without_the_reference_there_are_means_alone() -> None:
    asked = {key: value for key, value in ASKED.items() if key != "rows"}
    results = people({"wo_mot": LEVELS["wo_mot"]})
    (table,) = author_table.of_tables(RunTables(results), tables_of(asked, place="x.toml"))
    assert table.shown.frame.iloc[:, 0].tolist() == ["21.55"]


@pytest.mark.parametrize(
    ("form", "text"), [("mean", "25.50"), ("interval", "25.50 [23.45, 27.55]"), ("half-width", "25.50 ± 2.05")]
)
def test_the_mean_is_always_printed(form: str, text: str) -> None:
    assert made(LEVELS, form=form).shown.frame.iloc[0, 0] == text


def test_latex_compiles_alone_and_in_a_paper_of_two_columns(tmp_path: Path) -> None:
    text = author_table.latex([made(LEVELS), made(LEVELS, marks=[], wide=True, label="tab:wide")])
    check_latex(text)
    assert r"\textbf{25.50}" in text and "no\\_displacement" in text and text.count(r"\cellcolor") == 2
    (tmp_path / "table.tex").write_text(text)
    paper = "\\documentclass[twocolumn]{article}\\usepackage{booktabs,graphicx,colortbl}\\begin{document}\n"
    (tmp_path / "paper.tex").write_text(
        paper + "Before \\input{table} after, Table~\\ref{tab:width}.\n\\end{document}\n"
    )
    if (compiler := shutil.which("tectonic") or shutil.which("pdflatex")) is None:
        return  # The syntax is checked above.
    flags = ["-interaction=nonstopmode", "-halt-on-error"] if "pdflatex" in compiler else []
    for name in ("table", "paper"):
        done = subprocess.run(
            [compiler, *flags, f"{name}.tex"], cwd=tmp_path, capture_output=True, text=True, check=False
        )
        assert done.returncode == 0 and (tmp_path / f"{name}.pdf").exists(), done.stdout[-2000:]


def test_a_table_of_a_run_is_written_and_kept(run: Run, tmp_path: Path) -> None:
    file = tmp_path / "mine.toml"
    file.write_text('[[table]]\ncolumns = ["psnr", "train_s"]\nrows = ["fake_bad", "fake_good", "wo_mot"]\n')
    paths = {name: tmp_path / f"table.{name}" for name in ("latex", "markdown", "csv")}
    shown = "\n".join(write_tables(run, file, **paths))
    numbers = author_table.load(run.folder, file)
    assert numbers["row"].drop_duplicates().tolist() == ["fake_bad", "fake_good", "w/o mot."]
    assert numbers.query("method == 'wo_mot'")["text"].tolist() == ["n/a", "n/a"]
    for text in (shown, *(path.read_text() for path in paths.values())):
        assert all(number in text for number in numbers["text"])
    (tmp_path / "run").mkdir()
    kept = Run(folder=tmp_path / "run", suite="s", about="", command="", cells=(), table=tables_of(ASKED, place="x"))
    write_run(kept)
    assert read_run(kept.folder).table == kept.table


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ('columns = ["psrn"]', "unknown metric 'psrn', expected one of psnr, "),
        ('columns = [{ metric = "psnr", split = "new" }]', "unknown split 'new', expected one of train_view, "),
        ('columns = [{ metric = "train_s", unit = "d" }]', "unknown unit 'd', expected one of s, min, h"),
        ('columns = ["psnr"]\nform = "delta"', "unknown form 'delta', expected one of half-width, "),
        ('columns = ["psnr"]\nform = "difference"', "a difference needs `reference`"),
        ('columns = ["psnr"]\nrows = ["fake_god"]', "unknown row 'fake_god', the run has the methods fake_good, "),
        ('columns = ["psnr"]\nscene = "boxs"', "unknown scene 'boxs', the run has .* on boxes"),
        ('columns = ["psnr"]\nrow = 1', "unknown key 'row', expected some of columns, rows"),
        ('columns = ["psnr"]\nrows = ["wo_mot"]', "no row of its tables was run"),
    ],
)
def test_unknown_names_are_one_line_with_those_that_exist(run: Run, tmp_path: Path, text: str, message: str) -> None:
    file = tmp_path / "mine.toml"
    file.write_text(f"[[table]]\n{text}\n")
    with pytest.raises(InputError, match=message) as error:
        write_tables(run, file)
    assert "\n" not in str(error.value)
