"""Small studies of the embedded scenes, made once for all tests, in the precision of users."""

import functools

import equinox as eqx
import jax
import numpy as np

from experiments.bias_fits.bias_study import Study, Trial, prepare_study
from experiments.scene import Scene
from experiments.scenes import load_scene
from shadows.bias import CombinedBias, ConstantBias, SlopeBias
from shadows.window_filters import BilinearFilter
from tangentspace.shading import BlinnPhongShading

IMAGE_SIZE, MAP_SIZE = (128, 128), 256
BOTH = CombinedBias((ConstantBias(), SlopeBias()))
_VERTICES, _FACES = 10_300, 20_500  # what the largest scene needs


@functools.cache
def study(name: str) -> Study:
    """Return the study of an embedded scene under 2x2 lookup."""
    return study_of(load_scene(name))


def study_of(scene: Scene) -> Study:
    """Return the study of a scene; all have meshes of one size, so they compile once."""
    with jax.enable_x64(False):
        return prepare_study(
            padded(scene),
            image_size=IMAGE_SIZE,
            map_size=MAP_SIZE,
            filter=BilinearFilter(),
            shading=BlinnPhongShading(),
        )


def padded(scene: Scene) -> Scene:
    """Return the scene with zero-area faces and vertices that none of the others use."""
    mesh = scene.mesh
    more = _VERTICES - len(mesh.positions)
    faces = np.concatenate([mesh.faces, np.zeros((_FACES - len(mesh.faces), 3), np.int32)])
    mesh = mesh._replace(
        positions=np.concatenate([mesh.positions, np.repeat(mesh.positions[:1], more, axis=0)]),
        normals=np.concatenate([mesh.normals, np.zeros((more, 3), np.float32)]),
        faces=faces,
        uvs=None,
    )
    return scene._replace(mesh=mesh, face_materials=np.zeros(len(faces), np.int32))


def thinned(trial: Trial, count=6000) -> Trial:
    """Return a trial of so many pixels, spread over all of it: one shape, one compilation."""
    total = len(trial.receiver.depth)
    chosen = np.linspace(0, total - 1, count).astype(int)
    thin = jax.tree.map(lambda a: a[chosen] if np.shape(a)[:1] == (total,) else a, trial)
    return eqx.tree_at(lambda t: t.goal.surface_count, thin, replace_fn=lambda n: n * count / total)
