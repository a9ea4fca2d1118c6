"""What is drawn besides avatars."""

from pathlib import Path

import numpy as np
from helpers.captures import write_tube_capture

from benchmarks.play.cameras import resized
from benchmarks.play.picture import DARK, LIGHT, _fit
from benchmarks.play.shelf import TruthPicture
from benchmarks.play.state import ViewState


def test_a_truth_in_other_pixels_has_no_fringe(tmp_path: Path) -> None:
    """A soft disc in the colour of what is behind it cannot be seen; in another colour it can."""
    own = write_tube_capture(tmp_path / "capture").cameras["cam0"]
    rows, columns = np.mgrid[: own.height, : own.width] + 0.5
    alpha = np.clip(15 - np.hypot(rows - own.height / 2, columns - own.width / 2), 0, 1)
    for dark, colour in ((False, LIGHT), (True, DARK)):
        premultiplied = alpha[..., None] * np.array([*colour, 255])
        truth = TruthPicture(camera=own, on_black=np.rint(premultiplied).astype(np.uint8))
        camera = resized(own, width=150, height=130)
        shown = _fit(truth, camera, ViewState(left="", dark=dark)).astype(int)
        assert shown.shape == (130, 150, 3) and np.abs(shown - np.array(colour)).max() <= 3
        assert np.abs(_fit(truth, camera, ViewState(left="", dark=not dark)) - shown).max() > 100
