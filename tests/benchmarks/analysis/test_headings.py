"""Accuracy on headings that training did not see."""

import numpy as np
import pandas as pd
import pytest

from ash.capture.dataset import Motion
from benchmarks.analysis.headings import by_heading, changes, heading_deg

# Degrees of the heading by frame of one capture, and what each method scores there.
DEGREES = {("anna", 0): 0.0, ("anna", 1): 20.0, ("anna", 2): 90.0, ("anna", 3): 61.0}
SCORES = {"ash": (27.0, 26.0, 19.0, 17.0), "ash_plus": (28.0, 28.0, 27.0, 28.0)}


def images(scene: str = "loose", capture: str = "anna", split: str = "near_pose") -> pd.DataFrame:
    return pd.DataFrame(
        {"scene": scene, "method": method, "capture": capture, "seed": 0, "split": split, "frame": frame, "psnr": psnr}
        for method, scores in SCORES.items()
        for frame, psnr in enumerate(scores)
    )


def test_the_nearest_heading_of_training_counts_whatever_the_person_leans_to_and_across_half_a_turn() -> None:
    turns = np.deg2rad([10.0, 170.0, 40.0, -175.0, -60.0])
    rotvecs = np.stack([np.zeros(5), turns, np.zeros(5)], axis=1)
    rotvecs[2] = (0.3, 0.0, 0.0)  # leans forward, and faces as it did
    dofs = np.concatenate([np.zeros((5, 3)), rotvecs, np.ones((5, 6))], axis=1).astype(np.float32)
    motion = Motion(dofs=dofs, sequence=np.zeros(5, dtype=np.int64), fps=30.0)
    assert heading_deg(motion, train=(0, 1), test=(2, 3, 4)) == pytest.approx([10.0, 15.0, 70.0], abs=1e-3)


def test_images_of_new_poses_are_averaged_by_heading() -> None:
    table = by_heading(pd.concat([images(), images(split="novel_view").assign(psnr=99.0)]), DEGREES)
    found = {(row.method, row.bin): (row.psnr, row.frames, row.captures) for row in table.itertuples()}
    assert found["ash", "beyond 60 deg"] == (18.0, 2, 1) and found["ash", "15 to 60 deg"] == (26.0, 1, 1)
    assert found["ash_plus", "up to 15 deg"] == (28.0, 1, 1) and len(found) == 6
    (sentence,) = changes(table)
    assert sentence.startswith("On loose, from up to 15 deg to beyond 60 deg (frames: 2, captures: 1)")
    assert sentence.endswith("PSNR changes: ASH+ -0.5 dB, ASH -9.0 dB.")


def test_scenes_that_show_no_such_heading_and_captures_that_are_not_at_hand_have_no_rows() -> None:
    both = pd.concat([images(), images(scene="tight", capture="bert"), images(scene="lit", capture="carl")])
    near = {("bert", frame): 5.0 for frame in range(4)}
    assert set(by_heading(both, DEGREES | near)["scene"]) == {"loose"}
    assert by_heading(both, {}).empty and by_heading(both.drop(columns="psnr"), DEGREES).empty
