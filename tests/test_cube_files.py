"""Six image files as a cube map: order, names, formats, and what is wrong with the files."""

import numpy as np
import pytest
from PIL import Image

from experiments.files.cube_files import read_cube_map
from experiments.files.images import write_exr, write_png

NAMES = {
    "short": "px nx py ny pz nz",
    "long": "posx negx posy negy posz negz",
    "words": "right left top bottom front back",
}


def write(path, image):
    if path.suffix == ".exr":
        write_exr(path, dict(zip("RGB", np.moveaxis(image, -1, 0), strict=True)))
    elif path.suffix == ".png":
        write_png(path, image)
    else:
        Image.fromarray(np.rint(255 * image).astype(np.uint8)).save(path, quality=100)


def six_faces(size=4):
    """Each face a gray of its own, with a white first texel."""
    faces = np.broadcast_to(np.linspace(0, 0.5, 6)[:, None, None, None], (6, size, size, 3)).copy()
    faces[:, 0, 0] = 1
    return faces.astype(np.float32)


def write_faces(folder, names, suffix, *, skip=()):
    paths = [folder / f"{name}{suffix}" for name in names.split()]
    for path, face in zip(paths, six_faces(), strict=True):
        if path.stem not in skip:
            write(path, face)
    return paths


@pytest.mark.parametrize("names", NAMES)
def test_folder_of_six_names(tmp_path, names):
    write_faces(tmp_path, NAMES[names], ".exr")
    faces = read_cube_map(tmp_path).faces
    assert faces.dtype == np.float32
    np.testing.assert_array_equal(faces, six_faces())
    np.testing.assert_array_equal(read_cube_map(str(tmp_path)).faces, faces)


def test_files_in_the_order_given(tmp_path):
    paths = write_faces(tmp_path, "a b c d e f", ".exr")
    np.testing.assert_array_equal(read_cube_map(paths).faces, six_faces())
    turned = read_cube_map([str(path) for path in paths[::-1]])
    np.testing.assert_array_equal(turned.faces, six_faces()[::-1])


def test_png_is_decoded_from_srgb(tmp_path):
    write_faces(tmp_path, NAMES["short"], ".png")
    np.testing.assert_allclose(read_cube_map(tmp_path).faces, six_faces(), atol=4e-3)  # 1.6e-3


@pytest.mark.parametrize("suffix", [".jpg", ".jpeg", ".JPG"])
def test_jpeg_is_decoded_from_srgb(tmp_path, suffix):
    for name in NAMES["long"].split():
        write(tmp_path / f"{name.upper()}{suffix}", np.full((8, 8, 3), 188 / 255))
    np.testing.assert_allclose(read_cube_map(tmp_path).faces, 0.5029, atol=6e-3)  # measured 2e-5


def test_other_files_in_the_folder_do_not_matter(tmp_path):
    write_faces(tmp_path, NAMES["words"], ".exr")
    (tmp_path / "px.txt").write_text("notes")
    write(tmp_path / "px.png", np.zeros((3, 3, 3)))
    (tmp_path / "old").mkdir()
    np.testing.assert_array_equal(read_cube_map(tmp_path).faces, six_faces())


def flaw(kind, folder):
    """A set of files with something wrong, and what read_cube_map is given."""
    paths = write_faces(folder, NAMES["short"], ".exr", skip=("ny",) if "missing" in kind else ())
    if kind == "not square":
        write(paths[3], np.zeros((4, 6, 3)))
    elif kind == "other size":
        write(paths[3], np.zeros((2, 2, 3)))
    elif kind == "twice":
        write(folder / "ny.png", np.zeros((4, 4, 3)))
    elif kind == "broken":
        paths[3].write_bytes(b"no image")
    elif kind == "not a number":
        write(paths[3], np.full((4, 4, 3), np.nan))
    files = ("missing file", "five", "not a number")
    return paths[: 5 if kind == "five" else 6] if kind in files else folder


FLAWS = {
    "missing face": "no image of ny; expected px nx py ny pz nz, each ending in one of .exr, .png",
    "missing file": r"ny\.exr: no such file",
    "five": "expected 6 files in the order .* got 5",
    "not square": r"ny\.exr: expected a square face, got 6 x 4",
    "other size": r"ny\.exr: expected a face of 4 x 4 as px\.exr, got 2 x 2",
    "twice": r"holds one face twice, ny\.exr and ny\.png",
    "broken": r"ny\.exr: not an EXR image",
    "not a number": r"ny\.exr: 16 of 16 texels are NaN",
}


@pytest.mark.errors
@pytest.mark.parametrize("kind", FLAWS)
def test_flaws_are_one_clear_line(tmp_path, kind):
    given = flaw(kind, tmp_path)
    with pytest.raises(ValueError, match=FLAWS[kind]) as caught:
        read_cube_map(given)
    assert "\n" not in str(caught.value)


@pytest.mark.errors
@pytest.mark.parametrize("name", ["nowhere", "empty"])
def test_folder_without_faces(tmp_path, name):
    (tmp_path / "empty").mkdir()
    message = "there is none" if name == "nowhere" else "no image of px, nx, py, ny, pz, nz"
    with pytest.raises(ValueError, match=f"{name}: .*{message}"):
        read_cube_map(tmp_path / name)
