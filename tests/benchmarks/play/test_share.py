"""`export --format html`: the page in a real browser, beside our own picture; other exports in its viewer."""

import base64
import io
import json
import re
import zlib
from pathlib import Path

import numpy as np
import pytest
import torch
from helpers.browser import Visitor
from helpers.scoring import psnr
from PIL import Image

from ash.capture.dataset import Camera, Pose
from ash.protocol import StageClock
from benchmarks import cli
from benchmarks.play.avatars import open_avatars
from benchmarks.play.share import COLUMNS

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


@pytest.fixture(scope="module")
def page(tube_cells: dict[str, Path], tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("shared") / "avatar.html"
    assert (
        cli.main(["export", str(tube_cells["ash"]), "--format", "html", "--motion", "train", "--out", str(out)])
        == cli.DONE
    )
    return out


def test_the_page_draws_in_a_browser_what_we_draw(page: Path, tube_cells: dict[str, Path], visit: Visitor) -> None:
    visited = visit(page, size=(200, 200))
    tab = visited.page
    with open_avatars(tube_cells["ash"]) as avatars:
        tab.wait_for_function("window.avatar", timeout=PATIENCE)
        tab.keyboard.press(" ")
        assert not tab.evaluate("window.avatar.playing")
        loaded, capture = avatars[avatars.titles[0]], avatars.capture
        for frame, name in ((0, "cam1"), (3, "cam3")):
            camera = capture.cameras[name]
            tab.evaluate("([f, m, v, w, h]) => window.avatar.look(f, m, v, w, h)", [frame, *seen_by(camera)])
            tab.wait_for_function("window.avatar.resting", timeout=PATIENCE)
            theirs = decoded(tab.evaluate("window.avatar.picture()"))
            ours = loaded.on_colour(Pose(capture.motion, frame), camera, StageClock(), PAPER) / 255
            alpha = loaded.premultiplied(Pose(capture.motion, frame), camera, StageClock())[..., 3]
            assert theirs.shape == ours.shape and (alpha > 0.5).mean() > 0.05
            assert psnr(theirs, ours, alpha) > 40 and psnr(theirs, ours, np.ones_like(alpha)) > 40
        tab.keyboard.press("ArrowRight")
        assert tab.evaluate("window.avatar.shown") == 0, "after the last frame comes the first"
    assert visited.errors == [] and visited.requests == [], "it needs no network"


def seen_by(camera: Camera) -> list[object]:
    """How three.js describes a camera: its matrix, the field of view, width and height."""
    matrix = np.linalg.inv(camera.viewmat) @ np.diag([1.0, -1, -1, 1])
    fov = float(np.rad2deg(2 * np.arctan2(camera.height / 2, camera.K[1, 1])))
    return [matrix.T.ravel().tolist(), fov, camera.width, camera.height]


def decoded(url: str) -> np.ndarray:
    """The colours of a picture in a data URL."""
    return np.asarray(Image.open(io.BytesIO(base64.b64decode(url.partition(",")[2]))).convert("RGB")) / 255


def test_a_viewer_that_is_not_ours_shows_exported_files_as_the_avatar_renders(
    page: Path, tube_cells: dict[str, Path], tmp_path: Path, visit: Visitor
) -> None:
    """Spark, which the page brings along."""
    visited = visit(page, size=(200, 200))
    visited.page.wait_for_function("window.avatar", timeout=PATIENCE)
    visited.page.keyboard.press(" ")  # The page's own clip stands still meanwhile.
    with open_avatars(tube_cells["ash"]) as avatars:
        loaded, camera = avatars[avatars.titles[0]], avatars.capture.cameras["cam2"]
        pose = Pose(avatars.capture.motion, 2)
        ours = loaded.on_colour(pose, camera, StageClock(), PAPER) / 255
        alpha = loaded.premultiplied(pose, camera, StageClock())[..., 3]
        dilation = loaded.avatar.dilation
    assert (alpha > 0.5).mean() > 0.05
    for form, turned in (("ply", True), ("spz", False)):
        out = tmp_path / f"frame.{form}"
        command = ["export", str(tube_cells["ash"]), "--format", form, "--motion", "train", "--frames", "2"]
        assert cli.main([*command, "--out", str(out)]) == cli.DONE
        content = base64.b64encode(out.read_bytes()).decode()
        theirs = decoded(visited.page.evaluate(OPEN, [content, form, turned, *seen_by(camera), dilation]))
        assert psnr(theirs, ours, alpha) > 30, form
    assert visited.errors == []


def test_the_page_holds_every_frame_to_its_bytes(page: Path, tube_cells: dict[str, Path]) -> None:
    text = page.read_text()
    clip = json.loads(re.search(r'id="clip">(.*?)</script>', text)[1])
    packed = zlib.decompress(base64.b64decode(re.search(r'id="frames">(.*?)</script>', text)[1]))
    columns_of_all = COLUMNS + 3 * 8  # degree 2
    size = clip["count"] * columns_of_all
    steps = np.frombuffer(packed, dtype=np.uint8).reshape(clip["frames"], size)
    bytes_of = np.cumsum(steps, axis=0, dtype=np.uint64).astype(np.uint8).reshape(clip["frames"], columns_of_all, -1)
    high, low = np.array(clip["high"])[:, None], np.array(clip["low"])[:, None]
    with open_avatars(tube_cells["ash"]) as avatars:
        loaded, capture = avatars[avatars.titles[0]], avatars.capture
        for frame, columns in enumerate(bytes_of):
            wanted = loaded.avatar.gaussians(Pose(capture.motion, frame))
            position = low + (high - low) * (256.0 * columns[:3] + columns[3:6]) / 65535
            np.testing.assert_allclose(position.T, wanted.means, atol=1e-4)
            turns = columns[9:13].astype(np.int8).T / 127
            unit = torch.nn.functional.normalize(wanted.quats, dim=-1).numpy()
            assert np.abs((turns * unit).sum(1)).min() > 0.985
            np.testing.assert_allclose(columns[16] / 255, wanted.opacities, atol=0.51 / 255)
            above = columns[17:].astype(np.int8).T / 127 * clip["harmonics"]
            np.testing.assert_allclose(
                above, wanted.sh[:, 1:].reshape(len(above), -1), atol=0.51 * clip["harmonics"] / 127
            )


def test_the_page_names_its_libraries_licences_and_loads_nothing(page: Path) -> None:
    text = page.read_text()
    assert text.count("MIT License") + text.count("The MIT License") >= 2 and "three.js" in text
    assert "@@" not in text.partition('<script type="text/plain"')[0]
    assert not re.search(r'(src|href)="(?!#)', text)
    assert "default-src 'none'" in text


def test_what_cannot_be_shared_is_refused(tube_run: Path, tube_cells, tmp_path: Path, capsys) -> None:
    for arguments, words in (
        ([str(tube_cells["ash"]), "--out", str(tmp_path / "a.txt")], "ends with .html"),
        ([str(tube_cells["ddc"]), "--out", str(tmp_path / "a.html")], "has no Gaussians"),
        ([str(tube_run), "--out", str(tmp_path / "a.html")], "expected one avatar"),
        ([str(tube_cells["ash"]), "--motion", "fly", "--out", str(tmp_path / "a.html")], "expected train, test, walk"),
        ([str(tube_cells["ash"]), "--motion", "walk", "--out", str(tmp_path / "a.html")], "a person's skeleton"),
    ):
        assert cli.main(["export", "--format", "html", *arguments]) == cli.WRONG_INPUT
        assert words in capsys.readouterr().err
    assert not list(tmp_path.iterdir())
