"""Meshes that Draco compressed (KHR_draco_mesh_compression), decoded by DracoPy.

Source: Khronos, KHR_draco_mesh_compression. A file that does not require the extension has plain accessors, which wrt reads instead.
"""

from typing import Any

from wrt.core.errors import InputError
from wrt.core.packages import needed_by
from wrt.io.gltf.accessors import Accessors
from wrt.io.gltf.document import Document, GltfObject
from wrt.io.gltf.schema import DracoMesh

READ = ("POSITION", "NORMAL", "TEXCOORD_0", "JOINTS_", "WEIGHTS_")
NAME = "KHR_draco_mesh_compression"


def decode(document: Document, accessors: Accessors, primitive: GltfObject, place: str) -> int:
    """Decode a compressed primitive into its accessors. Return its mode, which is 4 (a list of triangles) for every compressed primitive.

    Raises InputError if DracoPy is missing, or if the data are damaged or do not fit the accessors."""
    compressed = document.extension(primitive, NAME, DracoMesh, place)
    if compressed is None or NAME not in (document.gltf.extensionsRequired or ()):
        return int(primitive.mode)
    where = f"{place}.extensions.{NAME}"
    if primitive.mode not in (4, 5) or primitive.indices is None:
        raise InputError("must be a list or a strip of triangles (mode 4 or 5) with indices", place=place)
    with needed_by("a glTF file with Draco compression"):
        import DracoPy
    data, _ = document.view(compressed.bufferView, f"{where}.bufferView")
    try:
        mesh: Any = DracoPy.decode(data.tobytes())
        faces, arrays = mesh.faces, {each["unique_id"]: each["data"] for each in mesh.attributes}
    except Exception as error:  # DracoPy's own classes; AttributeError for a point cloud
        raise InputError(f"is not a mesh that Draco compressed ({error})", place=where) from error
    if primitive.mode == 5:  # the count is that of a strip, but Draco holds triangles
        document.item("accessors", primitive.indices, f"{place}.indices").count = faces.size
    accessors.put(primitive.indices, faces.reshape(-1, 1), f"{place}.indices")
    for name, unique_id in compressed.attributes.items():
        if not name.startswith(READ):
            continue
        if unique_id not in arrays or name not in primitive.attributes:
            raise InputError("must be an attribute of the primitive and of the compressed mesh", place=f"{where}.attributes.{name}")
        array = arrays[unique_id]
        accessors.put(primitive.attributes[name], array.reshape(len(array), -1), f"{place}.attributes.{name}")
    return 4
