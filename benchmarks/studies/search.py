"""`ash-bench search`: is a method trained as well as it could be? Its preset, with one setting changed at a time.

The exam is not looked at: one training camera is kept apart, and settings are compared on it. ASH and the mesh baseline
are searched alike: the same settings, the same factors, the same budget.
"""

import multiprocessing
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from ash.avatar import AshAvatar
from ash.capture.dataset import Capture, Pose, Split
from ash.capture.formats import load_capture
from ash.capture.typed import from_json
from ash.config import TrainingConfig
from ash.files import InputError, read_json, write_atomic, write_json
from ash.presets import named
from ash.protocol import Avatar, StageClock
from baselines.ddc import DdcAvatar, ddc_config
from benchmarks import provenance
from benchmarks.cell import metrics
from benchmarks.cell.views import spread

AS_IT_IS = "preset"
SEARCHED = ("ash", "ddc")
VALIDATION_FRAMES = 12


@dataclass(frozen=True, kw_only=True, slots=True)
class Setting:
    """One configuration of the search. `config` is an AshConfig or a DdcConfig."""

    name: str  # what is changed; "preset": nothing
    value: str
    config: Any


@dataclass(frozen=True, kw_only=True, slots=True)
class SearchResult:
    """What one training came to, on the camera that was kept apart."""

    name: str
    value: str
    seed: int
    psnr: float  # foreground, dB
    train_s: float
    params: int


def settings(method: str, preset: str, *, seed: int) -> list[Setting]:
    """The preset, and each setting at half and at twice its value.

    Raises:
        InputError: the method is not searched, or the preset is unknown.
    """
    if method not in SEARCHED:
        raise InputError(f"search: expected one of {', '.join(SEARCHED)}, got {method!r}")
    ash = replace(named(preset), seed=seed)
    config: Any = ash if method == "ash" else ddc_config(ash, seed=seed, template=ash.template)
    found = [Setting(name=AS_IT_IS, value="", config=config)]
    for factor in (0.5, 2.0):
        for name, change in TRAINING.items():
            training = change(config.training, factor)
            value = f"{training.steps}" if name == "steps" else f"{getattr(training, name.replace(' ', '_')):g}"
            found.append(Setting(name=name, value=value, config=replace(config, training=training)))
        if method == "ash":
            texels = int(ash.model.texels * factor)
            found.append(
                Setting(name="texels", value=str(texels), config=replace(ash, model=replace(ash.model, texels=texels)))
            )
        else:
            texture = int(config.texture * factor)
            found.append(Setting(name="texture", value=str(texture), config=replace(config, texture=texture)))
    return sorted(found, key=lambda setting: (setting.name != AS_IT_IS, setting.name))


TRAINING: dict[str, Callable[[TrainingConfig, float], TrainingConfig]] = {
    "learning rate": lambda t, f: replace(t, learning_rate=t.learning_rate * f),
    "base learning rate": lambda t, f: replace(t, base_learning_rate=t.base_learning_rate * f),
    "steps": lambda t, f: replace(t, steps=int(t.steps * f), warmup_steps=int(t.warmup_steps * f)),
}


def search(
    method: str, capture: Path, out: Path, *, preset: str, seeds: int, workers: int, command: str = ""
) -> list[SearchResult]:
    """Train every setting that is not in `out` yet, and write the table there."""
    loaded = load_capture(capture)
    count = len(settings(method, preset, seed=0))
    tasks = [(method, str(capture), str(out), preset, seed, index) for seed in range(seeds) for index in range(count)]
    with ProcessPoolExecutor(workers, mp_context=multiprocessing.get_context("spawn")) as pool:
        found = list(pool.map(_train, *zip(*tasks, strict=True)))
    made = provenance.machine()
    size = loaded.manifest.size or "unknown"
    notes = (
        f"\nScene `{loaded.scene}`, size `{size}`; one thread each, {workers} side by side."
        f" `{command}`, commit {provenance.commit()}, {made['cores']} cores of {made['processor']}.\n"
    )
    write_atomic(out / f"search-{method}.md", (table(method, preset, found) + notes).encode())
    return found


def table(method: str, preset: str, found: list[SearchResult]) -> str:
    """Markdown: one row per setting, means over seeds, best first within what is changed."""
    rows = list(dict.fromkeys((one.name, one.value) for one in found))
    mean = {row: [one for one in found if (one.name, one.value) == row] for row in rows}
    base = float(np.mean([one.psnr for one in mean[AS_IT_IS, ""]]))
    seeds = len(mean[AS_IT_IS, ""])
    lines = [
        f"# Search: {method}, preset {preset}",
        "",
        f"One setting changed at a time; foreground PSNR on a training camera that was kept apart; {seeds} seed(s).",
        "",
        "| changed | to | PSNR, dB | against the preset | training, s | parameters |",
        "|---|---:|---:|---:|---:|---:|",
    ]
    for (name, value), ones in mean.items():
        psnr, seconds = float(np.mean([one.psnr for one in ones])), float(np.mean([one.train_s for one in ones]))
        lines.append(f"| {name} | {value} | {psnr:.2f} | {psnr - base:+.2f} | {seconds:.0f} | {ones[0].params} |")
    return "\n".join(lines) + "\n"


def without_one_camera(capture: Capture) -> tuple[Capture, Split]:
    """The training part without one of its cameras, and that camera's views: what settings are compared on.

    Raises:
        InputError: there is only one training camera.
    """
    seen = capture.training_only()
    train = seen.splits["train"]
    if len(train.cameras) < 2:
        raise InputError(f"{capture.folder}: a search needs two training cameras or more, got one")
    apart = train.cameras[len(train.cameras) // 2]
    rest = train.only(cameras=[name for name in train.cameras if name != apart])
    own = train.only(cameras=(apart,))
    frames = [own.frames[i] for i in spread(len(own.frames), VALIDATION_FRAMES)]
    return replace(seen, splits={"train": rest}), own.only(frames=frames)


def _train(method: str, folder: str, out: str, preset: str, seed: int, index: int) -> SearchResult:
    """One training, in a process of its own; taken from `out` where it is there already."""
    setting = settings(method, preset, seed=seed)[index]
    place = Path(out) / f"{method}-{seed}-{setting.name.replace(' ', '_')}-{setting.value or 'as_it_is'}"
    if (place / "found.json").exists():
        return _read(place / "found.json")
    import torch

    torch.set_num_threads(1)
    capture, apart = without_one_camera(load_capture(Path(folder)))
    capture = replace(capture, store=Path(out) / "templates")
    avatar = AshAvatar(setting.config, capture) if method == "ash" else DdcAvatar(setting.config, capture)
    avatar.fit(capture, folder=place)
    outcome = avatar.outcome()
    assert outcome is not None, "it has just been trained"
    found = SearchResult(
        name=setting.name,
        value=setting.value,
        seed=seed,
        psnr=_psnr(avatar, capture, apart),
        train_s=outcome.seconds,
        params=avatar.parameter_count(),
    )
    write_json(place / "found.json", asdict(found))
    return found


def _read(path: Path) -> SearchResult:
    """A training's result, where an earlier search left it.

    Raises:
        InputError: it is damaged.
    """
    try:
        found: SearchResult = from_json(SearchResult, read_json(path))
        return found
    except ValueError as error:
        raise InputError(f"{path}: expected what a search found ({error}); deleted, it is made anew") from error


def _psnr(avatar: Avatar, capture: Capture, split: Split) -> float:
    scores = []
    for name, frame in split.views:
        truth = metrics.on_black(capture.image(name, frame))
        drawn = metrics.quantise(avatar.render(Pose(capture.motion, frame), capture.cameras[name], clock=StageClock()))
        scores.append(metrics.psnr(drawn[..., :3], truth[..., :3], metrics.foreground(truth)))
    return float(np.mean(scores))
