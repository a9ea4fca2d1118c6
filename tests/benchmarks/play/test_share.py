"""`export --format html`: the page in a real browser, beside our own picture; other exports in its viewer."""

import base64
import io
import re
from pathlib import Path

import numpy as np
import pytest
from helpers.browser import Visitor
from helpers.scoring import psnr
from PIL import Image

from ash.capture.dataset import Camera, Pose
from benchmarks import cli
from benchmarks.play.avatars import open_avatars
from benchmarks.report.pictures import on_paper

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
  const pictures = [];
  const still = () => pictures.at(-1) !== pictures[0] && pictures.at(-1) === pictures.at(-2);
  while (pictures.length < 60 && !still()) { // A worker sorts meanwhile; before, nothing is drawn.
    renderer.render(scene, camera);
    pictures.push(renderer.domElement.toDataURL("image/png"));
    await new Promise((done) => setTimeout(done, 150));
  }
  return pictures.at(-1);
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
            drawn = loaded.on_black(Pose(capture.motion, frame), camera)
            ours, alpha = on_paper(drawn) / 255, drawn[..., 3] / 255
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
        drawn = loaded.on_black(Pose(avatars.capture.motion, 2), camera)
        ours, alpha = on_paper(drawn) / 255, drawn[..., 3] / 255
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
