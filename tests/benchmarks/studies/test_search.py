"""The search of settings: alike for both methods, blind to the exam, and resumable."""

from dataclasses import replace
from pathlib import Path

import pytest
from helpers.captures import write_tube_capture

from ash import presets
from ash.config import AshConfig
from ash.files import InputError, write_json
from benchmarks.studies import search
from benchmarks.studies.search import AS_IT_IS, SearchResult, settings, table, without_one_camera


@pytest.fixture
def tiny(monkeypatch: pytest.MonkeyPatch) -> None:
    def config() -> AshConfig:
        base = presets.ci()
        model = replace(base.model, texels=16, shuffle=1, width=4, levels=2, window=2)
        return replace(base, model=model, training=replace(base.training, steps=6, warmup_steps=2))

    monkeypatch.setitem(presets.PRESETS, "ci", config)


def test_both_methods_are_searched_by_the_same_factors(tiny) -> None:
    found = {method: settings(method, "ci", seed=3) for method in ("ash", "ddc")}
    for method, rows in found.items():
        assert rows[0].name == AS_IT_IS and all(row.config.seed == 3 for row in rows)
        values = {name: [row.value for row in rows if row.name == name] for name in {row.name for row in rows}}
        assert values["learning rate"] == ["0.001", "0.004"] and values["steps"] == ["3", "12"]
        assert values["texels" if method == "ash" else "texture"] == (["8", "32"] if method == "ash" else ["16", "64"])
        for row in rows[1:]:
            assert row.config != rows[0].config
    names = [{row.name for row in rows} - {"texels", "texture"} for rows in found.values()]
    assert names[0] == names[1]
    with pytest.raises(InputError, match="one of ash, ddc"):
        settings("nearest", "ci", seed=0)


def test_a_training_camera_is_kept_apart_and_the_exam_is_not_seen(tmp_path: Path) -> None:
    whole = write_tube_capture(tmp_path / "capture")
    seen, apart = without_one_camera(whole)
    assert set(seen.splits) == {"train"}
    kept = seen.splits["train"].cameras
    assert len(apart.cameras) == 1 and apart.cameras[0] not in kept
    assert {*kept, *apart.cameras} == set(whole.splits["train"].cameras)
    assert set(apart.frames) <= set(whole.splits["train"].frames)
    with pytest.raises(InputError, match="two training cameras"):
        train = replace(whole.splits["train"], cameras=("cam1",))
        without_one_camera(replace(whole, splits=whole.splits | {"train": train}))


@pytest.mark.parametrize("method", ["ash", "ddc"])
def test_a_setting_is_trained_once_and_taken_from_its_file_afterwards(method: str, tiny, tmp_path: Path) -> None:
    capture = write_tube_capture(tmp_path / "capture")
    arguments = (method, str(capture.folder), str(tmp_path / "out"), "ci", 0, 0)
    first = search._train(*arguments)
    assert first.name == AS_IT_IS and 5 < first.psnr < 40 and first.params > 1000
    (place,) = (tmp_path / "out").glob(f"{method}-*")
    write_json(
        place / "found.json", {"name": AS_IT_IS, "value": "", "seed": 0, "psnr": 1.5, "train_s": 2.0, "params": 3}
    )
    assert search._train(*arguments).psnr == 1.5
    write_json(place / "found.json", {"name": AS_IT_IS, "psnr": "1.5"})
    with pytest.raises(InputError, match=r"found.json: expected what a search found"):
        search._train(*arguments)


def test_the_table_says_what_each_setting_is_worth() -> None:
    found = [
        SearchResult(name=name, value=value, seed=seed, psnr=psnr + seed, train_s=10.0, params=7)
        for seed in (0, 1)
        for name, value, psnr in ((AS_IT_IS, "", 20.0), ("steps", "500", 21.25))
    ]
    lines = table("ddc", "ci", found).splitlines()
    assert "2 seed(s)" in lines[2]
    assert lines[-2:] == ["| preset |  | 20.50 | +0.00 | 10 | 7 |", "| steps | 500 | 21.75 | +1.25 | 10 | 7 |"]
