"""Scenes by components: what ASH loses without a component, scene by scene, against what the scene should need.

The numbers are those of `differences`: a row that was compared with ASH has the same verdict in both tables.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import pandas as pd

from benchmarks.analysis import style
from benchmarks.analysis.differences import differences
from benchmarks.analysis.results import RunTables, foreground, of_quantity
from benchmarks.analysis.statistics import mean_interval
from benchmarks.analysis.style import style_of
from synth.presets import FACTORS

REFERENCE = "ash"
# Rows that have a component which ASH lacks, and what ASH is without; other additions change what ASH has.
ADDED = {
    f"plus_{name}": f"w/o {title}"
    for name, title, _ in style.ADDED
    if name in ("base", "light", "standardise", "heading", "background")
}
FLIPPED = {"better": "worse", "worse": "better"}
# Rows without the component that the one phenomenon of a scene needs.
EXPECTED: dict[str, tuple[str, ...]] = {
    "splats": (),
    "still": (),
    "skinned": (),
    "wrinkles": ("wo_mot", "wo_disp"),
    "swing": ("wo_mot", "window_1", "unlearned"),
    "lit": ("wo_phi", "plus_light"),
    "glossy": ("sh_0", "sh_1", "sh_2"),
    "turning": ("plus_heading",),
    "loose": ("unlearned",),
}
WHOLE_PEOPLE = ("loose",)  # Scenes of all phenomena together, which may need other components too.
COMPONENTS = tuple(dict.fromkeys(row for rows in EXPECTED.values() for row in rows))
SHOWN = frozenset((*COMPONENTS, *ADDED, "ddc"))  # Other rows are not ASH without one component.
# Scenes that test the reason of a surprise, and in what they differ.
OVERCAST = ("overcast", "under an even sky, where no lamp casts shadows")
CONTROL_SCENES = {
    **{(scene, "wo_mot"): OVERCAST for scene in ("skinned", "lit", "turning")},
    ("turning", "plus_heading"): ("turned_wrinkles", "with wrinkles at headings outside training"),
}
ZERO_STRENGTH = "skinned"  # equal to every factor scene of strength 0
STRENGTHS = {"_half": 0.5, "": 1.0, "_twice": 2.0}  # by the ending of a scene's name
OTHER_STRENGTHS = frozenset(f"{factor}{end}" for factor in FACTORS for end in STRENGTHS if end)  # scenes


@dataclass(frozen=True, kw_only=True, slots=True)
class AblationEffect:
    """A cell of the matrix: PSNR of ASH with the component minus without, dB. `verdict`: on ASH with the component.

    `needed`: how many people would give a verdict where it is unclear; infinite above a thousand, NaN if unknown.
    """

    scene: str
    row: str
    mean: float
    low: float
    high: float
    verdict: str
    needed: float

    @property
    def component(self) -> str:
        """What is missing, for readers."""
        return ADDED.get(self.row) or style_of(self.row).title

    @property
    def expected(self) -> bool:
        """Whether the scene's phenomenon needs the component."""
        return self.row in EXPECTED.get(self.scene, ())

    @property
    def text(self) -> str:
        """The loss with its interval."""
        return _in_db(self.mean, self.low, self.high)


def _in_db(mean: float, low: float, high: float) -> str:
    interval = "" if pd.isna(low) else f" [{low:+z.2f}, {high:+z.2f}]"
    return f"{mean:+z.2f} dB{interval}"


def effects(table: pd.DataFrame, split: str) -> list[AblationEffect]:
    """All cells of a split, from `differences`; components that scenes need first."""
    cells = []
    for row in table[(table["split"] == split) & (table["reference"] == REFERENCE)].itertuples():
        mean, low, high, verdict = row.mean, row.low, row.high, row.verdict
        if row.method in ADDED:
            mean, low, high, verdict = -mean, -high, -low, FLIPPED.get(verdict, verdict)
        if row.method in SHOWN:
            numbers = {"mean": mean, "low": low, "high": high, "verdict": verdict, "needed": row.needed}
            cells.append(AblationEffect(scene=row.scene, row=row.method, **numbers))
    order = [*COMPONENTS, *dict.fromkeys(effect.row for effect in cells)]
    return sorted(cells, key=lambda effect: order.index(effect.row))


def matrix(tables: RunTables, table: pd.DataFrame, split: str) -> list[AblationEffect]:
    """The cells of the matrix; none of fewer than two scenes or without an ablation."""
    cells = [effect for effect in effects(table, split) if effect.scene not in OTHER_STRENGTHS]
    scenes = [name for name in tables.scenes if name not in OTHER_STRENGTHS and REFERENCE in tables.methods(name)]
    return cells if len(scenes) > 1 and any(effect.row != "ddc" for effect in cells) else []


def surprises(cells: list[AblationEffect]) -> list[str]:
    """Sentences on the cells that contradict the expectation, with the result on the control scene, if it was run."""
    by_place = {(effect.scene, effect.row): effect for effect in cells}
    sentences = []
    for effect in cells:
        if effect.scene not in EXPECTED or effect.row not in COMPONENTS:
            continue
        text = f"{effect.scene}, {effect.component}: {effect.text}, {effect.verdict}"
        if effect.expected and effect.verdict in ("equivalent", "worse"):
            text += ", although the scene should need it."
        elif not effect.expected and effect.verdict in ("better", "worse") and effect.scene not in WHOLE_PEOPLE:
            text += ", although the scene should not need it."
        else:
            continue
        control, differs = CONTROL_SCENES.get((effect.scene, effect.row), ("", ""))
        if (control, effect.row) in by_place:
            text += f" Control scene {control}, {differs}: {by_place[control, effect.row].text}."
        sentences.append(text)
    return sentences


def undecided(cells: list[AblationEffect]) -> list[str]:
    """Sentences on the components that a scene should need and whose verdict is unclear: how many people it takes."""
    sentences = []
    for effect in cells:
        if effect.expected and not math.isnan(effect.needed):
            people = "more than a thousand people" if math.isinf(effect.needed) else f"about {effect.needed:.0f} people"
            sentences.append(f"{effect.scene}, {effect.component}: {effect.text}; {people} would decide.")
    return sentences


def more_than_without(rows: pd.DataFrame, scene: str, row: str, split: str) -> str:
    """How much more is lost without a component on a scene than on that of strength 0, with its 95 % interval over the
    people of both, dB; empty where they have fewer than two in common, or a cell failed.

    `rows`: of both scenes (`benchmarks.analysis.results.load`).
    """
    chosen = of_quantity(rows, foreground(split))
    by_person = chosen.pivot_table(index="subject", columns=["scene", "method"], values="value")
    places = [(place, method) for place in (scene, ZERO_STRENGTH) for method in (REFERENCE, row)]
    failed = chosen.loc[chosen["status"] != "done", ["scene", "method"]].itertuples(index=False, name=None)
    if scene == ZERO_STRENGTH or not set(places) <= set(by_person.columns) or not set(places).isdisjoint(failed):
        return ""
    more = by_person[places].dropna().to_numpy() @ ((-1, 1, 1, -1) if row in ADDED else (1, -1, -1, 1))
    return _in_db(*mean_interval(more)) if len(more) > 1 else ""


def scenes_by_strength(factor: str) -> dict[float, str]:
    """A factor scene at all its strengths above 0, the weakest first."""
    return {strength: f"{factor}{end}" for end, strength in STRENGTHS.items()}


def more_by_strength(rows: pd.DataFrame, factor: str, row: str, split: str) -> str:
    """`more_than_without` at every strength of a factor that was run, in words; empty where none was."""
    found = {s: more_than_without(rows, scene, row, split) for s, scene in scenes_by_strength(factor).items()}
    return ", ".join(f"{text} at {strength:g}" for strength, text in found.items() if text)


def strength_curves(rows: pd.DataFrame, split: str) -> pd.DataFrame:
    """Loss by strength of a phenomenon, of the rows that its scene needs: scene, component, row, strength, mean, low,
    high; where two strengths were run, 1 among them. A curve is of the people who are on all its scenes.

    `rows`: of all scenes (`benchmarks.analysis.results.load`).
    """
    points = []
    for factor in FACTORS:
        scenes = {0.0: ZERO_STRENGTH} | scenes_by_strength(factor)
        for row in EXPECTED[factor]:
            compared = differences(_on_same_people(rows, [*scenes.values()], row))
            by_scene = {effect.scene: effect for effect in effects(compared, split)}
            by_strength = {s: by_scene[scene] for s, scene in scenes.items() if scene in by_scene}
            if len(by_strength) > 1 and 1.0 in by_strength:
                points += [(factor, e.component, row, s, e.mean, e.low, e.high) for s, e in by_strength.items()]
    return pd.DataFrame(points, columns=["scene", "component", "row", "strength", "mean", "low", "high"])


def _on_same_people(rows: pd.DataFrame, scenes: Sequence[str], row: str) -> pd.DataFrame:
    """ASH and a row on those of the scenes where both ran, of the people who are on all of these."""
    own = rows[rows["scene"].isin(scenes) & rows["method"].isin((REFERENCE, row))]
    ran = own.groupby(["subject", "scene"])["method"].nunique().unstack("scene") == 2
    ran = ran.loc[:, ran.any()]
    return own[own["scene"].isin(ran.columns) & own["subject"].isin(ran.index[ran.all(axis=1)])]
