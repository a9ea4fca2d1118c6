"""Scans: noise of the stated size along the normal, holes where fewer than two cameras see the surface."""

import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from helpers.scenes import small_scene
from scipy.spatial import cKDTree

from ash.capture.dataset import Camera, scan_path
from ash.capture.formats import load_capture, read_scan, read_surface_mesh_truth
from ash.capture.manifest import read_manifest
from ash.files import InputError
from synth.camera.render import Studio, probe
from synth.camera.scanning import FACING, facing_of_second, scan
from synth.capture import missing_views
from synth.person.body import vertex_normals
from synth.rendering import render_views, studio_of
from synth.scene import Scanner, stream
from synth.views import wanted_views


@pytest.fixture(scope="module")
def studio(small_capture: Path) -> Studio:
    """The person of the small capture's first frame."""
    capture = load_capture(small_capture)
    dressed = studio_of(small_scene(), capture.folder, probe())
    dressed.dress(read_surface_mesh_truth(capture, 0)[0])
    return dressed


@pytest.fixture(scope="module")
def normals(studio: Studio) -> np.ndarray:
    """Of its true surface."""
    return vertex_normals(studio.vertices.astype(np.float64), studio.surface.faces)


@pytest.fixture(scope="module")
def cameras(small_capture: Path) -> list[Camera]:
    """Those of training."""
    capture = load_capture(small_capture)
    return [capture.cameras[name] for name in capture.splits["train"].cameras]


def test_training_frames_are_scanned_and_the_manifest_says_how_well(small_capture: Path) -> None:
    folder = small_capture
    capture, manifest = load_capture(folder), read_manifest(folder)
    scanned = {name for name in manifest.files if name.startswith("scans/")}
    assert scanned == {str(scan_path(Path(), frame)) for frame in capture.splits["train"].frames}
    assert manifest.parameters["scanner"] == {"rms_mm": 1.0, "bump_share": 0.5, "bump_mm": 60.0}
    sizes = {len(read_scan(capture, frame)[0]) for frame in capture.splits["train"].frames}
    assert len(sizes) > 1 and max(sizes) < 0.95 * len(read_surface_mesh_truth(capture, 0)[0])


def test_a_scan_is_a_function_of_the_seed_and_the_frame(
    studio: Studio, cameras: list[Camera], small_capture: Path
) -> None:
    scene = small_scene()
    vertices, faces = scan(studio, cameras, scene.scanner, seed=stream(scene, "scan", 0))
    stored = read_scan(load_capture(small_capture), 0)
    assert np.array_equal(vertices, stored[0].astype(np.float32)) and np.array_equal(faces, stored[1])
    other, _ = scan(studio, cameras, scene.scanner, seed=stream(scene, "scan", 1))
    assert other.shape == vertices.shape and not np.array_equal(other, vertices)


@pytest.mark.parametrize("share", [0.0, 0.5, 1.0])
def test_a_scan_is_off_along_the_normal_by_exactly_the_stated_rms(
    share: float, studio: Studio, normals: np.ndarray, cameras: list[Camera]
) -> None:
    scanner = Scanner(rms_mm=0.4, bump_share=share, bump_mm=40.0)
    vertices, faces = scan(studio, cameras, scanner, seed=3)
    surface = studio.vertices.astype(np.float64)
    _, nearest = cKDTree(surface).query(vertices)
    off = vertices - surface[nearest]
    height = (off * normals[nearest]).sum(1)
    assert np.abs(off - height[:, None] * normals[nearest]).max() < 1e-6
    assert 1e3 * np.sqrt(np.mean(height**2)) == pytest.approx(0.4, rel=1e-3)
    ends = np.unique(np.sort(np.concatenate([faces[:, :2], faces[:, 1:]]), 1), axis=0)
    alike = np.corrcoef(height[ends[:, 0]], height[ends[:, 1]])[0, 1]
    assert {0.0: -0.05 < alike < 0.05, 0.5: 0.3 < alike < 0.6, 1.0: alike > 0.7}[share]


def test_the_error_grows_where_no_two_cameras_look_squarely(
    studio: Studio, normals: np.ndarray, cameras: list[Camera]
) -> None:
    surface = studio.vertices.astype(np.float64)
    squarely = facing_of_second(studio, cameras, surface, normals)
    vertices, _ = scan(studio, cameras, Scanner(rms_mm=0.4), seed=3)
    _, nearest = cKDTree(surface).query(vertices)
    height, facing = ((vertices - surface[nearest]) * normals[nearest]).sum(1), squarely[nearest]
    aside, square = height[facing < 0.3], height[facing > 0.8]
    assert facing.min() > FACING and len(aside) > 20 and len(square) > 20
    assert np.sqrt(np.mean(aside**2)) > 2 * np.sqrt(np.mean(square**2))


def test_two_cameras_must_see_what_is_scanned(studio: Studio, normals: np.ndarray, cameras: list[Camera]) -> None:
    camera, surface = cameras[0], studio.vertices.astype(np.float64)
    assert not facing_of_second(studio, [camera], surface, normals).any()
    twice = facing_of_second(studio, [camera, camera], surface, normals)
    towards = camera.position - surface
    facing = (towards * normals).sum(1) / np.linalg.norm(towards, axis=1)
    seen = twice > 0
    np.testing.assert_allclose(twice[seen], facing[seen], atol=1e-9)
    hit, _ = studio.hits(camera.position, surface)
    hidden = np.linalg.norm(hit - surface, axis=1) > 0.01
    assert seen.sum() > 500 and not (seen & hidden).any() and not (seen & (facing < FACING)).any()


def test_a_studio_without_a_scanner_has_no_scans(tmp_path: Path, small_capture: Path) -> None:
    other = shutil.copytree(small_capture, tmp_path / "other")
    shutil.rmtree(other / "scans")
    bare = replace(small_scene(), scanner=Scanner(rms_mm=0.0))
    views = wanted_views(bare)
    assert missing_views(small_scene(), other, views) and not missing_views(bare, other, views)
    render_views(bare, other, probe(), views[:1])
    assert not (other / "scans").exists()


@pytest.mark.parametrize("wrong", [{"rms_mm": -1.0}, {"bump_share": 1.5}, {"bump_mm": 0.0}])
def test_a_scanner_that_cannot_be_is_refused(wrong: dict[str, float]) -> None:
    with pytest.raises(InputError, match="scanner"):
        Scanner(**wrong)
