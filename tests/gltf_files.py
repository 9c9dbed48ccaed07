"""glTF files for tests, packed from arrays."""

import io
import json
import struct

import numpy as np
from PIL import Image

from experiments.files.gltf import load_gltf

CODES = {"i1": 5120, "u1": 5121, "i2": 5122, "u2": 5123, "u4": 5125, "f4": 5126}
TYPES = {1: "SCALAR", 2: "VEC2", 3: "VEC3", 4: "VEC4"}
# A sheet in the plane z = 0, facing +z, whose v_gltf grows downwards.
SHEET = {
    "POSITION": np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]], np.float32),
    "NORMAL": np.tile(np.array([0, 0, 1], np.float32), (4, 1)),
    "TEXCOORD_0": np.array([[0, 1], [1, 1], [1, 0], [0, 0]], np.float32),
    "TANGENT": np.tile(np.array([1, 0, 0, 1], np.float32), (4, 1)),
}
SHEET_FACES = np.array([0, 1, 2, 0, 2, 3], np.uint16)


def f32(values):
    return np.asarray(values, np.float32)


def indices(mesh):
    return np.asarray(mesh.faces).ravel().astype(np.uint16)


class Builder:
    """Packs arrays into one buffer and writes the document around it."""

    def __init__(self):
        self.data = b""
        self.document = {"asset": {"version": "2.0"}, "nodes": []}

    def add(self, kind, item):
        self.document.setdefault(kind, []).append(item)
        return len(self.document[kind]) - 1

    def view(self, data, **more):
        self.data += b"\0" * (-len(self.data) % 4)
        place = {"buffer": 0, "byteOffset": len(self.data), "byteLength": len(data), **more}
        self.data += data
        return self.add("bufferViews", place)

    def accessor(self, array, **more):
        array = np.asarray(array)
        columns = 1 if array.ndim == 1 else array.shape[1]
        return self.add(
            "accessors",
            {
                "bufferView": self.view(array.tobytes()),
                "componentType": CODES[array.dtype.str[1:]],
                "count": len(array),
                "type": TYPES[columns],
                **more,
            },
        )

    def primitive(self, attributes=SHEET, faces=SHEET_FACES, **more):
        stored = {name: self.accessor(array) for name, array in attributes.items()}
        return {"attributes": stored, "indices": self.accessor(faces), **more}

    def mesh(self, *primitives):
        return self.add("meshes", {"primitives": list(primitives)})

    def node(self, **content):
        return self.add("nodes", content)

    def light(self, **content):
        self.document["extensionsUsed"] = ["KHR_lights_punctual"]
        extensions = self.document.setdefault("extensions", {"KHR_lights_punctual": {"lights": []}})
        lights = extensions["KHR_lights_punctual"]["lights"]
        lights.append(content)
        return {"KHR_lights_punctual": {"light": len(lights) - 1}}

    def texture(self, pixels, form="PNG"):
        file = io.BytesIO()
        Image.fromarray(np.array(pixels, np.uint8)).save(file, form)
        return self.add(
            "textures", {"source": self.add("images", {"bufferView": self.view(file.getvalue())})}
        )

    def glb(self, path):
        self.document.setdefault("buffers", [{"byteLength": len(self.data)}])
        text = json.dumps(self.document).encode()
        text += b" " * (-len(text) % 4)
        data = self.data + b"\0" * (-len(self.data) % 4)
        chunks = struct.pack("<I4s", len(text), b"JSON") + text
        chunks += struct.pack("<I4s", len(data), b"BIN\0") + data
        path.write_bytes(struct.pack("<4sII", b"glTF", 2, 12 + len(chunks)) + chunks)
        return path

    def gltf(self, path, uri):
        self.document["buffers"] = [{"byteLength": len(self.data), "uri": uri}]
        path.write_text(json.dumps(self.document))
        return path


def quaternion(axis, degrees):
    half = np.deg2rad(degrees) / 2
    return [*(np.sin(half) * np.array(axis) / np.linalg.norm(axis)).tolist(), np.cos(half)]


def sheet_scene(tmp_path, **node):
    """The sheet under a node, lit so that no floor is added."""
    build = Builder()
    build.node(mesh=build.mesh(build.primitive()), **node)
    build.node(extensions=build.light(type="directional"))
    return load_gltf(build.glb(tmp_path / "sheet.glb"))
