"""An exported file opened by a splat viewer that is not ours: Spark, as shared pages carry it, in a real browser."""

import base64
import io
from pathlib import Path

import numpy as np
import pytest
from helpers.browser import Visitor
from helpers.scoring import psnr
from PIL import Image

from ash.capture.dataset import Pose
from ash.protocol import StageClock
from benchmarks import cli
from benchmarks.play.avatars import open_avatars

PAPER = (236, 236, 236)
PATIENCE = 120_000  # milliseconds: software graphics on a busy machine

# Opens a file in a scene of its own and looks at it; half a turn about x is how three.js shows a world whose y is down.
OPEN = """async ([bytes, type, turned, matrix, fov, width, height, dilation]) => {
  const fileBytes = Uint8Array.from(atob(bytes), (c) => c.charCodeAt(0));
  const renderer = new Splats.WebGLRenderer({ antialias: false, preserveDrawingBuffer: true });
  renderer.setPixelRatio(1); renderer.setSize(width, height, false);
  const scene = new Splats.Scene();
  scene.background = new Splats.Color("#ececec");
  scene.add(new Splats.SparkRenderer({
    renderer, preBlurAmount: dilation, blurAmount: 0, maxStdDev: Math.sqrt(11), minAlpha: 1 / 255, sortRadial: false,
  }));
  const mesh = new Splats.SplatMesh({ fileBytes, fileType: type });
  await mesh.initialized;
  if (turned) mesh.quaternion.set(1, 0, 0, 0);
  scene.add(mesh);
  const camera = new Splats.PerspectiveCamera(fov, width / height, 0.05, 100);
  new Splats.Matrix4().fromArray(matrix).decompose(camera.position, camera.quaternion, camera.scale);
  for (let k = 0; k < 8; k++) { // A worker sorts between two of them.
    renderer.render(scene, camera);
    await new Promise((done) => setTimeout(done, 150));
  }
  return renderer.domElement.toDataURL("image/png");
}"""


@pytest.mark.parametrize(("form", "turned"), [("ply", True), ("spz", False)])
def test_a_viewer_shows_the_frame_that_the_avatar_renders(
    form: str, turned: bool, tube_cells: dict[str, Path], tmp_path: Path, visit: Visitor
) -> None:
    page, out = tmp_path / "page.html", tmp_path / f"frame.{form}"
    cell = str(tube_cells["ash"])
    assert (
        cli.main(["export", cell, "--format", "html", "--motion", "train", "--frames", "0", "--out", str(page)])
        == cli.DONE
    )
    command = ["export", cell, "--format", form, "--motion", "train", "--frames", "2", "--out", str(out)]
    assert cli.main(command) == cli.DONE
    visited = visit(page, size=(200, 200))
    visited.page.wait_for_function("window.avatar", timeout=PATIENCE)
    visited.page.keyboard.press(" ")  # The page's own clip stands still meanwhile.
    with open_avatars(tube_cells["ash"]) as avatars:
        loaded, camera = avatars[avatars.titles[0]], avatars.capture.cameras["cam2"]
        matrix = np.linalg.inv(camera.viewmat) @ np.diag([1.0, -1, -1, 1])
        fov = float(np.rad2deg(2 * np.arctan2(camera.height / 2, camera.K[1, 1])))
        view = [matrix.T.ravel().tolist(), fov, camera.width, camera.height, loaded.avatar.dilation]
        encoded = visited.page.evaluate(OPEN, [base64.b64encode(out.read_bytes()).decode(), form, turned, *view])
        pose = Pose(avatars.capture.motion, 2)
        ours = loaded.on_colour(pose, camera, StageClock(), PAPER) / 255
        alpha = loaded.premultiplied(pose, camera, StageClock())[..., 3]
    theirs = np.asarray(Image.open(io.BytesIO(base64.b64decode(encoded.partition(",")[2]))).convert("RGB")) / 255
    assert (alpha > 0.5).mean() > 0.05
    assert psnr(theirs, ours, alpha) > 30, psnr(theirs, ours, alpha)
    assert visited.errors == []
