"""Claims, and what the rows of runs say of each: `claims.toml` holds those of the paper and of our README."""

import math
import tomllib
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

import pandas as pd

from ash.capture.typed import from_json
from ash.files import InputError
from benchmarks.analysis.results import Quantity, samples_of
from benchmarks.analysis.statistics import Comparison, compare_samples, corrected
from benchmarks.analysis.style import listed, style_of
from benchmarks.cell.metrics import METRICS
from synth.person.cast import VALIDATION

Expected = Literal["better", "worse", "equivalent", "not better", "not worse"]
Verdict = Literal["confirmed", "confirmed but smaller", "not shown", "contradicted", "cannot be judged here"]
HOLDS: tuple[Verdict, ...] = ("confirmed", "confirmed but smaller")
FILE = Path(__file__).with_name("claims.toml")
NO_SCENE = "no run of this scene"
COLUMNS = [
    *("name", "scene", "says", "where", "contrast", "paper", "effect", "low", "high", "p", "people", "unit"),
    *("verdict", "needed", "short_of_plateau", "because"),
]
# What each verdict of `compare` on `a` makes of what was expected of it. What is missing was not shown.
DECIDES: dict[Expected, dict[str, Verdict]] = {
    "better": {"better": "confirmed", "equivalent": "contradicted", "worse": "contradicted"},
    "worse": {"worse": "confirmed", "equivalent": "contradicted", "better": "contradicted"},
    "equivalent": {"equivalent": "confirmed", "better": "contradicted", "worse": "contradicted"},
    "not better": {"worse": "confirmed", "equivalent": "confirmed", "better": "contradicted"},
    "not worse": {"better": "confirmed", "equivalent": "confirmed", "worse": "contradicted"},
}


@dataclass(frozen=True, kw_only=True, slots=True)
class Claim:
    """What is claimed, and the contrast that decides it: row `a` against row `b`. See `claims.toml`."""

    name: str
    says: str
    where: str
    a: str = ""
    b: str = ""
    scenes: tuple[str, ...] = ("",)
    split: str = "novel_view"
    region: str = "foreground"
    metric: str = "psnr"
    expect: Expected = "better"
    least: float | None = None
    paper: dict[str, float] = field(default_factory=dict)
    condition: str = ""
    experiment: str = ""
    cannot: str = ""

    @property
    def quantity(self) -> Quantity:
        """What is compared."""
        return Quantity(self.split, self.region, self.metric)


def read_claims(path: Path = FILE) -> tuple[Claim, ...]:
    """The claims of a file.

    Raises:
        InputError: an entry is incomplete, or names what is not there.
    """
    try:
        entries = tomllib.loads(path.read_text())["claim"]
        claims = tuple(from_json(Claim, entry) for entry in entries)
    except (OSError, UnicodeDecodeError, tomllib.TOMLDecodeError, KeyError, TypeError, ValueError) as error:
        raise InputError(f"{path}: expected entries [[claim]] ({error})") from error
    for claim in claims:
        if claim.metric not in METRICS:
            raise InputError(f"{path}: {claim.name}: metric: expected {', '.join(METRICS)}, got {claim.metric!r}")
        if not claim.cannot and not (claim.a and claim.b and all(claim.scenes)):
            raise InputError(f"{path}: {claim.name}: expected a, b and scenes, or cannot")
    names = [claim.name for claim in claims]
    if twice := sorted({name for name in names if names.count(name) > 1}):
        raise InputError(f"{path}: two claims are called {', '.join(twice)}")
    return claims


def judge(claims: Sequence[Claim], rows: pd.DataFrame) -> pd.DataFrame:
    """Every claim on every scene of it: `COLUMNS`. `effect` is `a` minus `b`, `needed` people would decide,
    `short_of_plateau` are the rows with a training that ended before its plateau, `because` says why it is not judged.

    `rows`: as `analysis.results.load` has them; people for validation decide nothing. p is corrected over all claims
    (Holm), those without a row too: what is run later takes no verdict away. A claim about a single person is not
    judged, for one person says nothing about others.
    """
    rows = rows[rows["subject"] < VALIDATION]
    of_scene = {scene: rows[rows["scene"] == scene] for claim in claims for scene in claim.scenes}
    contrasts = [(claim, scene, *_compared(claim, of_scene[scene])) for claim in claims for scene in claim.scenes]
    planned = sum(not claim.cannot for claim, *_ in contrasts)
    tests = iter(corrected([test for _, _, test, _ in contrasts if test is not None], planned))
    records = []
    for claim, scene, test, missing in contrasts:
        record: dict[str, Any] = {
            "name": claim.name,
            "scene": scene,
            "says": claim.says,
            "where": claim.where,
            "contrast": f"{claim.a} - {claim.b}" if claim.a else "",
            "paper": claim.paper.get(scene),
            "unit": METRICS[claim.metric].unit,
            "verdict": "cannot be judged here",
            "because": missing,
        }
        if test is not None:
            test = next(tests)
            record |= {"effect": test.mean, "low": test.low, "high": test.high, "p": test.p, "people": test.captures}
            record["verdict"] = _verdict(claim, scene, test)
            record["short_of_plateau"] = _short_of_plateau(claim, of_scene[scene])
            if record["verdict"] == "not shown":
                beyond = claim.least if claim.expect in ("better", "worse") else 0.0
                record["needed"] = test.captures_needed(beyond or 0.0)
        records.append(record)
    return pd.DataFrame(records, columns=COLUMNS)


def _compared(claim: Claim, rows: pd.DataFrame) -> tuple[Comparison | None, str]:
    """The comparison over people, or why there is none."""
    if claim.cannot:
        return None, claim.cannot
    if rows.empty:
        return None, NO_SCENE
    for method in (claim.a, claim.b):
        cells = rows[rows["method"] == method]
        if cells.empty:
            return None, f"no row {method}"
        if failed := int((cells.drop_duplicates(["seed", "capture"])["status"] != "done").sum()):
            return None, f"{failed} cells of {method} failed"
    samples, metric = samples_of(rows, claim.quantity), METRICS[claim.metric]
    test = compare_samples(
        samples.get(claim.a, {}),
        samples.get(claim.b, {}),
        margin=metric.abs_tol if claim.least is None else claim.least,
        higher_is_better=metric.direction == "up",
    )
    if test is None:
        return None, f"{metric.title} was not measured of both on a capture"
    return (test, "") if test.captures else (None, "one person")


def _short_of_plateau(claim: Claim, rows: pd.DataFrame) -> str:
    """Titles of those of the two rows that ended a training before its plateau. `rows`: of one scene."""
    ended = rows[(rows["metric"] == "plateau") & (rows["value"] < 1)]
    return listed([style_of(row).title for row in (claim.a, claim.b) if (ended["method"] == row).any()])


def _verdict(claim: Claim, scene: str, test: Comparison) -> Verdict:
    verdict = DECIDES[claim.expect].get(test.verdict, "not shown")
    low, high = sorted((test.low, test.high) if test.higher_is_better else (-test.low, -test.high))
    if (claim.expect == "not worse" and low >= -test.margin) or (claim.expect == "not better" and high <= test.margin):
        verdict = "confirmed"
    least = -math.inf if claim.least is None else claim.least
    if verdict == "confirmed" and not {"better": low > least, "worse": -high > least}.get(claim.expect, True):
        verdict = "not shown"
    published = claim.paper.get(scene)
    if verdict == "confirmed" and claim.expect in ("better", "worse") and published is not None:
        far = test.high if published > 0 else test.low  # The end of the interval that lies nearest to the publication.
        if abs(far) < abs(published):
            verdict = "confirmed but smaller"
    return verdict


def broken(before: pd.DataFrame, after: pd.DataFrame) -> list[str]:
    """The claims that held before and do not hold now; what cannot be judged any more is among them."""
    held = before[before["verdict"].isin(HOLDS)]
    now = after.set_index(["name", "scene"])["verdict"]
    lost = []
    for name, scene, verdict in zip(held["name"], held["scene"], held["verdict"], strict=True):
        verdict_now = now.get((name, scene), "not asked")
        if verdict_now not in HOLDS:
            lost.append(f"{name}{scene and f', {scene}'}: {verdict} before, {verdict_now} now")
    return lost
