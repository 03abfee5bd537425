"""Bodies for the renderer of a page: little-endian numbers in base64."""

import base64
from typing import Any

import numpy as np
import numpy.typing as npt

from haptether.view.scene3d.parts import Part


def packed(values: npt.ArrayLike, kind: str = "<f4") -> str:
    """Encode numbers row by row; `kind` is a NumPy data type."""
    return base64.b64encode(np.ascontiguousarray(values, dtype=kind).tobytes()).decode()


def geometry(part: Part) -> dict[str, Any]:
    """Encode a body in its own frame, without its pose."""
    return {
        "name": part.name,
        "station": part.station,
        "colour": part.colour,
        "opacity": part.opacity,
        "points": packed(part.mesh.points),
        "normals": packed(part.mesh.normals),
        "triangles": packed(part.mesh.triangles, "<u2"),
    }
