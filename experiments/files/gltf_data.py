"""glTF 2.0 containers: the JSON document, and the numbers and images it points to.

Follows the glTF 2.0 specification (Khronos, ISO/IEC 12113:2022), sections 3.6 (binary
data), 3.8.3 (images) and 4 (GLB). trimesh's loader reads these too, but drops tangents,
lights and second UV sets.
"""

import base64
import io
import json
import struct
from pathlib import Path
from typing import Any, NamedTuple
from urllib.parse import unquote

import numpy as np
from jaxtyping import Float, Num

from tangentspace.texture import Wrap, clamp, mirror, repeat

from .mesh_build import SceneFileError
from .texture_file import Pixels, read_pixels

_SUPPORTED = {"KHR_lights_punctual", "KHR_mesh_quantization"}
_TYPES = {5120: "i1", 5121: "u1", 5122: "<i2", 5123: "<u2", 5125: "<u4", 5126: "<f4"}
_COLUMNS = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4}
_REPEAT = 10497
_WRAPS: dict[int, Wrap] = {_REPEAT: repeat, 33071: clamp, 33648: mirror}


class GltfData(NamedTuple):
    """A glTF file in memory.

    Attributes:
        path: The file; relative addresses start at its folder.
        document: Its JSON.
        buffers: The bytes of each buffer.
    """

    path: Path
    document: dict[str, Any]
    buffers: tuple[bytes, ...]

    def items(self, kind: str) -> list[dict[str, Any]]:
        """Return a top-level array of the document, empty if it has none."""
        return self.document.get(kind, [])

    def numbers(self, accessor_index: int) -> Num[np.ndarray, "rows columns"]:
        """Return an accessor's rows; normalized integers as floats, others as stored."""
        accessor = self.items("accessors")[accessor_index]
        dtype = np.dtype(_TYPES[accessor["componentType"]])
        shape = (accessor["count"], _COLUMNS[accessor["type"]])
        values = np.zeros(shape, dtype)
        if "bufferView" in accessor:
            values = self._rows(accessor, dtype, shape)
        if "sparse" in accessor:
            sparse = accessor["sparse"]
            index_type = np.dtype(_TYPES[sparse["indices"]["componentType"]])
            index = self._rows(sparse["indices"], index_type, (sparse["count"], 1))
            values = values.copy()
            values[index[:, 0]] = self._rows(sparse["values"], dtype, (sparse["count"], shape[1]))
        if accessor.get("normalized") and dtype.kind in "iu":
            return np.maximum(values.astype(np.float64) / np.iinfo(dtype).max, -1.0)
        return values

    def pixels(self, texture_index: int) -> Pixels | None:
        """Return a texture's image as its file stores it; None if only an extension has it.

        Raises:
            ValueError: If it is no image.
        """
        source = self.items("textures")[texture_index].get("source")
        if source is None:
            return None
        image = self.items("images")[source]
        if "bufferView" in image:
            data = self._view(image["bufferView"])
        else:
            data = _fetch(self.path, image["uri"], "texture")
        return read_pixels(io.BytesIO(data), f"texture {texture_index}")

    def wraps(self, texture_index: int) -> tuple[Wrap, Wrap]:
        """Return how a texture goes on beyond its borders, along u and along v."""
        index = self.items("textures")[texture_index].get("sampler")
        sampler = {} if index is None else self.items("samplers")[index]
        return _WRAPS[sampler.get("wrapS", _REPEAT)], _WRAPS[sampler.get("wrapT", _REPEAT)]

    def _rows(
        self, place: dict[str, Any], dtype: np.dtype, shape: tuple[int, int]
    ) -> Num[np.ndarray, "rows columns"]:
        """Return rows of a buffer view, which may stand further apart than they are long."""
        view = self.items("bufferViews")[place["bufferView"]]
        strides = (view.get("byteStride") or shape[1] * dtype.itemsize, dtype.itemsize)
        data = self._view(place["bufferView"])
        return np.ndarray(shape, dtype, data, place.get("byteOffset", 0), strides)

    def _view(self, view_index: int) -> bytes:
        """Return the bytes of a buffer view."""
        view = self.items("bufferViews")[view_index]
        start = view.get("byteOffset", 0)
        return self.buffers[view["buffer"]][start : start + view["byteLength"]]


class Node(NamedTuple):
    """A node of the scene's tree.

    Attributes:
        content: Its JSON.
        world_from_node: Acts on columns.
    """

    content: dict[str, Any]
    world_from_node: Float[np.ndarray, "4 4"]


def read_gltf(path: Path) -> tuple[GltfData, tuple[str, ...]]:
    """Read a .gltf or .glb file and everything but images that it refers to.

    Returns:
        The data, and notes on extensions that are passed over.

    Raises:
        SceneFileError: If the file is cut short, of another version, needs an extension
            that is not supported, or refers to a missing file.
    """
    content, binary = path.read_bytes(), b""
    if path.suffix.lower() == ".glb":
        content, binary = _split_glb(path, content)
    document = json.loads(content)
    version = str(document["asset"]["version"])
    if not version.startswith("2."):
        raise SceneFileError(f"{path}: is glTF version {version}, expected 2.0; convert it")
    for name in document.get("extensionsRequired", []):
        if name not in _SUPPORTED:
            raise SceneFileError(
                f"{path}: requires the glTF extension {name}, which is not supported; "
                "export it without"
            )
    ignored = sorted(set(document.get("extensionsUsed", [])) - _SUPPORTED)
    notes = (f"glTF extensions ignored: {', '.join(ignored)}",) if ignored else ()
    buffers = []
    for buffer in document.get("buffers", []):
        data = _fetch(path, buffer["uri"], "buffer") if "uri" in buffer else binary
        if len(data) < buffer["byteLength"]:
            raise SceneFileError(
                f"{path}: a buffer has {len(data)} of {buffer['byteLength']} bytes, the file is "
                "cut short; export it again"
            )
        buffers.append(data)
    return GltfData(path, document, tuple(buffers)), notes


def scene_nodes(data: GltfData) -> list[Node]:
    """Return the nodes of the file's scene, parents before children, in file order.

    Without a scene, every node that is no other's child is a root.
    """
    everything = data.items("nodes")
    children = {child for node in everything for child in node.get("children", [])}
    roots = [index for index in range(len(everything)) if index not in children]
    if scenes := data.items("scenes"):
        roots = scenes[data.document.get("scene", 0)].get("nodes", [])
    waiting = [(index, np.eye(4)) for index in reversed(roots)]
    nodes: list[Node] = []
    while waiting:
        index, world_from_parent = waiting.pop()
        if len(nodes) == len(everything):
            raise SceneFileError(f"{data.path}: its nodes form no tree; export it again")
        content = everything[index]
        nodes.append(Node(content, world_from_parent @ _parent_from_node(content)))
        below = nodes[-1].world_from_node
        waiting += [(child, below) for child in reversed(content.get("children", []))]
    return nodes


def _parent_from_node(node: dict[str, Any]) -> Float[np.ndarray, "4 4"]:
    """Return a node's transform: its matrix, or translation @ rotation @ scale."""
    if "matrix" in node:
        return np.array(node["matrix"], np.float64).reshape(4, 4).T
    matrix = np.eye(4)
    vector, w = np.split(np.array(node.get("rotation", [0, 0, 0, 1]), np.float64), [3])
    # Columns: each axis turned by the quaternion, e + 2 q x (q x e + w e), scaled.
    inner = np.cross(vector, np.eye(3)) + w * np.eye(3)
    matrix[:3, :3] = (np.eye(3) + 2 * np.cross(vector, inner)).T * node.get("scale", [1, 1, 1])
    matrix[:3, 3] = node.get("translation", [0, 0, 0])
    return matrix


def _split_glb(path: Path, content: bytes) -> tuple[bytes, bytes]:
    """Return the JSON and the binary chunk of a GLB file."""
    if not content.startswith(b"glTF"):
        raise SceneFileError(f"{path}: is not a GLB file (it does not begin with 'glTF')")
    length = struct.unpack_from("<I", content, 8)[0]
    if length > len(content):
        raise SceneFileError(
            f"{path}: has {len(content)} of {length} bytes, the file is cut short; export it again"
        )
    chunks, offset = {}, 12
    while offset + 8 <= length:
        size, kind = struct.unpack_from("<I4s", content, offset)
        chunks.setdefault(kind, content[offset + 8 : offset + 8 + size])
        offset += 8 + size
    return chunks[b"JSON"], chunks.get(b"BIN\0", b"")


def _fetch(path: Path, uri: str, what: str) -> bytes:
    """Return the bytes of a data URI, or of a file beside the glTF file."""
    if uri.startswith("data:"):
        return base64.b64decode(uri.partition(",")[2])
    file = path.parent / unquote(uri)
    if not file.is_file():
        raise SceneFileError(f"{path}: its {what} {uri} is missing; put it at {file}")
    return file.read_bytes()
