"""Claims on trial: a page and a table of what the rows of runs say of each."""

import os
from collections.abc import Iterator, Mapping, Sequence
from functools import partial
from itertools import chain
from pathlib import Path

import pandas as pd

from ash.files import InputError, write_atomic
from benchmarks.analysis.claims import HOLDS, Claim, broken, judge
from benchmarks.analysis.error_attribution import psnr_of
from benchmarks.analysis.results import load
from benchmarks.cell.metrics import METRICS
from benchmarks.cell.schema import ViewScore
from benchmarks.report import tables
from benchmarks.report.compare import Rows, Views, cells_by_row, same_person, shared_views
from benchmarks.report.content import Block, Bullets, Facts, Links, Mark, Section, Strip, Strips, Table, Text
from benchmarks.report.page import render
from benchmarks.report.pictures import Album
from benchmarks.report.sections import again
from benchmarks.report.sentences import sentence
from benchmarks.suites.runs import Run

ABOUT = (
    "A claim is judged by its contrast, the mean of the first row minus that of the second, in pairs over people; in "
    "brackets the 95 % interval. Confirmed: p below 5 % after Holm's correction over all claims, judged or not yet, "
    "and a difference above the smallest that counts (the whole interval, where the claim names how much); or an "
    "interval without a loss that counts, where the claim is that nothing is lost. Smaller: the whole interval lies "
    "below the published difference. Contradicted: the opposite was found, or no difference that counts. Not shown: "
    "neither; beside it how many people would decide, if difference and spread are those of all people (80 % power, "
    "after correction). "
    "The avatars are small and the people synthetic: differences are compared with the paper's, levels never."
)
ORDER = ("confirmed", "confirmed but smaller", "contradicted", "not shown", "cannot be judged here")
IN_IMAGES = ("psnr", "ssim", "flip", "lpips", "iou")


def write_claims(
    run: Run,
    claims: Sequence[Claim],
    out: Path,
    *,
    before: Path | None = None,
    reports: Mapping[tuple[str, str], Path] | None = None,
    command: str = "",
) -> tuple[list[str], list[str]]:
    """Write claims.csv, claims.md and claims.html to `out`.

    `before`: an earlier claims.csv; `reports`: pages to be linked, by scene and method; `command`: what does it again.
    Returns lines for the terminal, and the claims that held before and do not now.

    Raises:
        InputError: the run has no finished cell, or `before` is no claims.csv.
    """
    earlier = None if before is None else _read(before)
    rows = cells_by_row(run)
    table = judge(claims, _table(rows))
    lost = [] if earlier is None else broken(earlier, table)
    write_atomic(out / "claims.csv", table.to_csv(index=False, float_format="%.6g").encode())
    counts = table["verdict"].value_counts()
    found = ", ".join(f"{verdict} {counts[verdict]}" for verdict in ORDER if verdict in counts)
    headline = f"Of {len(table)} claims, each on its scene: {found}"
    judged, album = table[table["effect"].notna()], Album()
    by_name = {claim.name: claim for claim in claims}
    shown = printed(judged)
    sources = [_pages(by_name[row.name], row.scene, reports or {}) for row in judged.itertuples()]
    reports_of = [", ".join(page.parent.name for page in pages) for pages in sources]
    wide = shown.assign(**{"not at plateau": judged["short_of_plateau"].to_numpy(), "report": reports_of})
    marks: dict[tuple[int, int], Mark] = {}
    for row, verdict in enumerate(judged["verdict"]):
        if verdict in HOLDS or verdict == "contradicted":
            marks[row, list(shown.columns).index("verdict")] = "best" if verdict in HOLDS else "second"
    blocks: list[Block] = [Text(text=ABOUT)]
    blocks += [Table(frame=wide, corner="claim", marks=marks)] if len(shown) else []
    summaries = ((name, _summary(claim, table[table["name"] == name])) for name, claim in by_name.items())
    blocks.append(Facts(items=tuple(summaries)))
    if lost:
        blocks.insert(0, Bullets(items=tuple(lost)))
    if pages := dict.fromkeys(chain.from_iterable(sources)):
        links = tuple((f"Report of {page.parent.name}", Path(os.path.relpath(page, out))) for page in pages)
        blocks.append(Links(items=links))
    groups = tuple(_pictures(by_name, table, rows, album))
    page = [*blocks, *([Strips(file="", title="", groups=groups)] if groups else [])]
    for form, content in (("html", page), ("md", blocks)):
        section = Section(title="Claims", headline=f"{headline}.", blocks=tuple(content))
        text = render("ash-bench: claims", [section, *again(command)], form, album)  # type: ignore[arg-type]
        write_atomic(out / f"claims.{form}", text.encode())
    return [*([shown.to_string(), ""] if len(shown) else []), headline], lost


def printed(judged: pd.DataFrame) -> pd.DataFrame:
    """The claims that were judged as texts, by their names."""

    def number(value: float | None, unit: str = "") -> str:
        return "" if pd.isna(value) else f"{value:+.3g}{unit and ' ' + unit}"

    texts = pd.DataFrame(
        {
            "scene": row.scene,
            "verdict": row.verdict,
            "contrast": row.contrast,
            "difference": f"{number(row.effect, row.unit)} [{number(row.low)}, {number(row.high)}]",
            "paper": number(row.paper, row.unit),
            "people": str(int(row.people)),
            "needed": tables.people_needed(row.needed),
        }
        for row in judged.itertuples()
    )
    texts.index = pd.Index(judged["name"])
    return texts


def _summary(claim: Claim, rows: pd.DataFrame) -> str:
    """What is claimed and where, its condition here, why it is not judged, and where it does not hold an experiment."""
    sentences = [f"{claim.says[0].upper()}{claim.says[1:]} ({claim.where})"]
    if claim.condition:
        sentences.append(f"Condition: {claim.condition}")
    judged = rows["effect"].notna()
    for because, scenes in rows[~judged].groupby("because", sort=False)["scene"]:
        on = " and ".join(filter(None, scenes))
        sentences.append(f"Not judged{on and f' on {on}'}: {because}")
    if claim.experiment and not rows.loc[judged, "verdict"].isin(HOLDS).all():
        sentences.append(f"Experiment: {claim.experiment}")
    return " ".join(map(sentence, sentences))


def _pages(claim: Claim, scene: str, reports: Mapping[tuple[str, str], Path]) -> list[Path]:
    """The pages that have a claim's rows, the same one once."""
    return [*dict.fromkeys(reports[scene, row] for row in (claim.a, claim.b) if (scene, row) in reports)]


def _table(rows: Rows) -> pd.DataFrame:
    cells = [pair for of_row in rows.values() for pair in of_row]
    return load([result for _, result in cells], {cell.config.key: cell.capture_folder.name for cell, _ in cells})


def _read(path: Path) -> pd.DataFrame:
    try:
        table = pd.read_csv(path, keep_default_na=False)
    except (OSError, ValueError) as error:
        raise InputError(f"{path}: expected the claims.csv of an earlier judgement ({error})") from error
    if missing := {"name", "scene", "verdict"} - set(table.columns):
        raise InputError(
            f"{path}: expected the claims.csv of an earlier judgement, {', '.join(sorted(missing))} missing"
        )
    return table


def _pictures(
    claims: Mapping[str, Claim], table: pd.DataFrame, rows: Rows, album: Album
) -> Iterator[tuple[str, tuple[Strip, ...]]]:
    """Of each claim about pictures that was judged: truth and both rows, in the view of the median difference."""
    strips: dict[tuple[str, ...], Strip | None] = {}
    for name, scene, effect in zip(*(table[column] for column in ("name", "scene", "effect")), strict=True):
        claim = claims[name]
        if pd.isna(effect) or claim.metric not in IN_IMAGES:
            continue
        key = (scene, claim.a, claim.b, claim.split)
        if key not in strips:
            pair = same_person(rows[scene, claim.a], rows[scene, claim.b])
            median = partial(_median, split=claim.split)
            strips[key] = next((f.strip(album) for f in shared_views(pair, median)), None) if pair else None
        if (strip := strips[key]) is not None:
            yield f"{name} on {scene}: {METRICS[claim.metric].title}", (strip,)


def _median(views: Views, split: str) -> list[tuple[ViewScore, str]]:
    views = sorted((v for v in views if v[0].split == split), key=lambda both: psnr_of(both[0]) - psnr_of(both[1]))
    return [(view, "the view of the median difference") for view, _ in views[len(views) // 2 :][:1]]
