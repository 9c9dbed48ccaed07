"""Cameras and KHR_lights_punctual lights of glTF scenes; both look along their node's -z."""

from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from shadows.lights import DirectionalLight, Light, PointLight, SpotLight
from shadows.transforms import Camera, OrthographicCamera, PerspectiveCamera

from .framing import bounding_sphere
from .gltf_data import GltfData, Node

_WIDEST = np.deg2rad(89.0)  # a spot's half angle must stay below 90 degrees


def read_camera(data: GltfData, node: Node, points: Float[np.ndarray, "points 3"]) -> Camera:
    """Return a node's camera.

    The image's aspect ratio rules, not the file's. A perspective camera without a far plane
    gets one behind the points.
    """
    content = data.items("cameras")[node.content["camera"]]
    view_from_world = np.eye(4)
    view_from_world[:3, :3] = axes = _axes(node)
    view_from_world[:3, 3] = -axes @ node.world_from_node[:3, 3]
    matrix = view_from_world.astype(np.float32)
    if content["type"] == "orthographic":
        lens = content["orthographic"]
        return OrthographicCamera(matrix, *(_scalar(lens[k]) for k in ("ymag", "znear", "zfar")))
    lens = content["perspective"]
    depth = -(points @ view_from_world[2, :3] + view_from_world[2, 3])
    far = lens.get("zfar", max(1.05 * depth.max(), 2 * lens["znear"]))
    return PerspectiveCamera(matrix, _scalar(lens["yfov"]), _scalar(lens["znear"]), _scalar(far))


def read_lights(
    data: GltfData, nodes: list[Node], points: Float[np.ndarray, "points 3"]
) -> tuple[tuple[Light, ...], tuple[str, ...]]:
    """Return the scene's lights, brightest first, and notes.

    Photometric units need an exposure, which glTF does not give: one common factor makes
    the brightest light's largest channel 1 at the middle of the points' box (lux of a
    directional light, candela / distance^2 of a spot on its axis or a point light). A light
    nearer to the middle than a tenth of the points' radius counts as that far away.
    """
    centre, radius = bounding_sphere(points)
    library = data.document.get("extensions", {}).get("KHR_lights_punctual", {}).get("lights", [])
    found = []
    for node in nodes:
        extension = node.content.get("extensions", {}).get("KHR_lights_punctual")
        if extension is not None:
            light = library[extension["light"]]
            color = np.array(light.get("color", [1, 1, 1]), np.float64) * light.get("intensity", 1)
            if light["type"] != "directional":
                distance = np.linalg.norm(node.world_from_node[:3, 3] - centre)
                color /= max(distance, 0.1 * radius) ** 2
            found.append((light, node, color))
    lit = sorted((f for f in found if f[2].max() > 0), key=lambda f: -f[2].max())
    notes = ()
    if len(lit) < len(found):
        notes += (f"{len(found) - len(lit)} of {len(found)} lights give no light: left out",)
    if not lit:
        return (), notes
    factor = 1 / lit[0][2].max()
    notes += (
        f"light intensities scaled by {factor:.3g}: the brightest gives radiance 1 at the "
        "middle of the scene; none falls off with distance",
    )
    return tuple(_light(light, node, factor * color) for light, node, color in lit), notes


def _light(light: dict[str, Any], node: Node, color: Float[np.ndarray, "3"]) -> Light:
    """Return one light of the given color."""
    back = _axes(node)[2].astype(np.float32)
    position = node.world_from_node[:3, 3].astype(np.float32)
    color = color.astype(np.float32)
    if light["type"] == "directional":
        return DirectionalLight(direction=back, color=color)
    if light["type"] == "point":
        return PointLight(position=position, color=color)
    if light["type"] != "spot":
        raise ValueError(f"light type '{light['type']}'")
    cone = light.get("spot", {})
    return SpotLight(
        position=position,
        direction=-back,
        inner_angle=_scalar(min(cone.get("innerConeAngle", 0), _WIDEST)),
        outer_angle=_scalar(min(cone.get("outerConeAngle", np.pi / 4), _WIDEST)),
        color=color,
    )


def _axes(node: Node) -> Float[np.ndarray, "3 3"]:
    """Return the node's right, up and back in world space, freed of scale and mirroring."""
    _, up, back = node.world_from_node[:3, :3].T
    back = back / np.linalg.norm(back)
    right = np.cross(up, back)
    right /= np.linalg.norm(right)
    return np.array([right, np.cross(back, right), back])


def _scalar(number: float | int) -> Float[Array, ""]:
    """Return a number as a float32 array (a NumPy one would become a bare scalar when negated)."""
    return jnp.asarray(number, jnp.float32)
