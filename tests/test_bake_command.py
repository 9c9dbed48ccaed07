"""``bake-normals`` as a command: its files, what it says, and what it refuses."""

import functools

import jax
import numpy as np
import pytest
from PIL import Image

import experiments.baking.bake_command
from experiments.baking.bake_command import bake
from experiments.baking.bake_pictures import render_bake
from experiments.files.images import read_exr
from experiments.files.map_files import read_normal_map
from experiments.files.mesh_file import load_scene_file
from tangentspace.shapes import plane, uv_sphere

SMALL = {"size": 32, "samples": 1}


def write_obj(path, mesh, *, uvs=True):
    """Write a mesh that has one UV and normal per vertex."""
    lines = [f"v {x:.9g} {y:.9g} {z:.9g}" for x, y, z in mesh.positions]
    lines += [f"vn {x:.9g} {y:.9g} {z:.9g}" for x, y, z in mesh.normals]
    lines += [f"vt {u:.9g} {v:.9g}" for u, v in mesh.uvs] if uvs else []
    corner = "{0}/{0}/{0}" if uvs else "{0}//{0}"
    lines += ["f " + " ".join(corner.format(k + 1) for k in face) for face in mesh.faces]
    path.write_text("\n".join(lines) + "\n")
    return path


@pytest.fixture
def folder(monkeypatch, tmp_path):
    """Return a folder to work in, with a sphere and a larger one; in single precision."""
    monkeypatch.chdir(tmp_path)
    write_obj(tmp_path / "low.obj", uv_sphere(rings=12, segments=24))
    write_obj(tmp_path / "high.obj", uv_sphere(1.05, rings=24, segments=48), uvs=False)
    with jax.enable_x64(False):
        yield tmp_path


def contents(folder):
    return sorted(str(path.relative_to(folder)) for path in folder.rglob("*"))


def paths(*names):
    return [experiments.baking.bake_command.Path(name) for name in names]


def test_the_map_and_the_pictures_are_written(folder, monkeypatch, capsys):
    small = functools.partial(render_bake, image_size=(48, 48))
    monkeypatch.setattr(experiments.baking.bake_command, "render_bake", small)
    out, pictures = paths("map.png", "made/here")
    bake(*paths("high.obj", "low.obj"), out=out, pictures=pictures, **SMALL)
    assert contents(folder) == [
        *("high.obj", "low.obj", "made", "made/here", "made/here/comparison.png", "map.png"),
    ]
    texels = read_normal_map(out).texels
    assert texels.shape == (32, 32, 3)
    np.testing.assert_allclose(texels, np.broadcast_to([0.5, 0.5, 1], (32, 32, 3)), atol=1e-3)
    with Image.open(pictures / "comparison.png") as image:
        assert min(image.size) > 500
        assert len(image.convert("RGB").getcolors(2**24)) > 100
    said, progress = capsys.readouterr()
    assert "wrote map.png" in said
    assert "wrote made/here/comparison.png" in said
    assert "cage 0.0" in said
    assert [line.partition(":")[0] for line in progress.splitlines()][-2:] == [
        "baking",
        "rendering both meshes",
    ]


def test_an_exr_holds_what_a_png_rounds(folder):
    for name in ("map.exr", "map.png"):
        bake(*paths("high.obj", "low.obj"), out=paths(name)[0], **SMALL)
    exact = np.stack([read_exr("map.exr")[name] for name in "RGB"], axis=-1)
    rounded = read_normal_map("map.png").texels
    np.testing.assert_allclose(rounded, exact, atol=0.51 / 65535)
    lengths = np.linalg.norm(2 * exact.astype(np.float64) - 1, axis=-1)
    np.testing.assert_allclose(lengths, 1, atol=1e-6)


def test_the_floor_of_a_scene_is_no_part_of_the_mesh(folder):
    mesh = experiments.baking.bake_command._load_mesh(paths("low.obj")[0])
    assert len(mesh.faces) < len(load_scene_file("low.obj").mesh.faces)
    sphere = uv_sphere(rings=12, segments=24)
    assert mesh.faces.shape == sphere.faces.shape
    assert mesh.positions.shape == mesh.normals.shape == sphere.positions.shape
    assert mesh.uvs.shape == sphere.uvs.shape
    np.testing.assert_allclose(np.linalg.norm(mesh.positions, axis=1), 1, atol=1e-6)


def test_a_flat_mesh_is_baked_without_words_on_floors(folder, capsys):
    write_obj(folder / "plane.obj", plane())
    bake(*paths("plane.obj", "plane.obj"), out=paths("map.exr")[0], **SMALL)
    said, progress = capsys.readouterr()
    assert "floor" not in said + progress
    assert (read_exr("map.exr")["B"] == 1).all()


def test_what_is_odd_is_noted_with_the_files_name(folder, capsys):
    half = uv_sphere(1.05, rings=24, segments=48)
    up = half.positions[half.faces][..., 1].max(axis=1) > -0.5
    write_obj(folder / "high.obj", half._replace(faces=half.faces[up]), uvs=False)
    moved = uv_sphere(rings=12, segments=24)
    write_obj(folder / "low.obj", moved._replace(uvs=np.asarray(moved.uvs) + np.float32([0.5, 0])))
    bake(*paths("high.obj", "low.obj"), out=paths("map.png")[0], **SMALL)
    notes = [line for line in capsys.readouterr().err.splitlines() if line.startswith("note: ")]
    assert any("high.obj: " in note and "without a face" in note for note in notes)
    assert any("low.obj: " in note and "UVs outside [0, 1]" in note for note in notes)
    assert any("low.obj: " in note and "rays found no detail" in note for note in notes)


REFUSED = {
    "unknown suffix": ({"out": "map.jpg"}, "^map.jpg: expected a name that ends in .exr or .png"),
    "no folder": ({"out": "no/map.png"}, "^no/map.png: no folder no"),
    "no pictures": ({"pictures": "low.obj"}, "^low.obj: low.obj is a file, no folder"),
    "size": ({"size": 0}, "^--size: expected 1 to 8192, got 0"),
    "samples": ({"samples": 0}, "^--samples: expected 1 to 16, got 0"),
    "margin": ({"margin": -3}, "^--margin: expected 0 to 8192, got -3"),
    "cage": ({"cage": -1.0}, "^--cage: expected a finite world length above 0, got -1"),
    "no file": ({"high": "no.obj"}, "^no.obj: no such file"),
    "no uvs": ({"low": "high.obj"}, "^high.obj: has no UVs"),
    "elsewhere": ({"high": "far.obj"}, "^far.obj: no ray from low.obj meets it"),
    "beyond the cage": ({"cage": 0.01}, "^high.obj: 100% of the rays from low.obj do not meet it"),
}


@pytest.mark.errors
@pytest.mark.parametrize("flaw", REFUSED)
def test_what_is_refused_leaves_nothing(folder, flaw):
    changes, said = REFUSED[flaw]
    sphere = uv_sphere(rings=12, segments=24)
    far = sphere._replace(positions=sphere.positions + np.float32(9))
    write_obj(folder / "far.obj", far, uvs=False)
    before = contents(folder)
    arguments = {"high": "high.obj", "low": "low.obj", "out": "map.png", **SMALL, **changes}
    for name in {"high", "low", "out", "pictures"} & set(arguments):
        arguments[name] = paths(arguments[name])[0]
    high, low = arguments.pop("high"), arguments.pop("low")
    with pytest.raises(ValueError, match=said) as caught:
        bake(high, low, **arguments)
    assert "\n" not in str(caught.value)
    assert contents(folder) == before
