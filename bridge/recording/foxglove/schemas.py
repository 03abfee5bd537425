"""Foxglove schemas that are written, with the used fields only.

Source: Foxglove's message schemas FrameTransforms, PoseInFrame and SceneUpdate, as JSON.
"""

from typing import Any

Json = dict[str, Any]


def _object(title: str, **properties: Json) -> Json:
    return {"title": title, "type": "object", "properties": properties, "required": list(properties)}


def _array(items: Json) -> Json:
    return {"type": "array", "items": items}


NUMBER: Json = {"type": "number"}
TEXT: Json = {"type": "string"}
NANOSECONDS: Json = {"type": "integer", "minimum": 0, "maximum": 999_999_999}
TIME = _object("time", sec={"type": "integer", "minimum": 0}, nsec=NANOSECONDS)
DURATION = _object("duration", sec={"type": "integer"}, nsec=NANOSECONDS)
VECTOR = _object("foxglove.Vector3", x=NUMBER, y=NUMBER, z=NUMBER)
QUATERNION = _object("foxglove.Quaternion", x=NUMBER, y=NUMBER, z=NUMBER, w=NUMBER)
POSE = _object("foxglove.Pose", position=VECTOR, orientation=QUATERNION)
COLOUR = _object("foxglove.Color", r=NUMBER, g=NUMBER, b=NUMBER, a=NUMBER)
ARROW = _object(
    "foxglove.ArrowPrimitive",
    pose=POSE,
    shaft_length=NUMBER,
    shaft_diameter=NUMBER,
    head_length=NUMBER,
    head_diameter=NUMBER,
    color=COLOUR,
)
SPHERE = _object("foxglove.SpherePrimitive", pose=POSE, size=VECTOR, color=COLOUR)
PRIMITIVES = ("arrows", "cubes", "spheres", "cylinders", "lines", "triangles", "texts", "models")
"""Primitives of an entity; those that are not drawn are empty."""
ENTITY = _object(
    "foxglove.SceneEntity",
    timestamp=TIME,
    frame_id=TEXT,
    id=TEXT,
    lifetime=DURATION,
    frame_locked={"type": "boolean"},
    metadata=_array(_object("foxglove.KeyValuePair", key=TEXT, value=TEXT)),
    **{name: _array({"arrows": ARROW, "spheres": SPHERE}.get(name, {"type": "object"})) for name in PRIMITIVES},
)
DELETION = _object("foxglove.SceneEntityDeletion", timestamp=TIME, type={"type": "integer"}, id=TEXT)
TRANSFORM = _object(
    "foxglove.FrameTransform",
    timestamp=TIME,
    parent_frame_id=TEXT,
    child_frame_id=TEXT,
    translation=VECTOR,
    rotation=QUATERNION,
)

FRAME_TRANSFORMS = _object("foxglove.FrameTransforms", transforms=_array(TRANSFORM))
POSE_IN_FRAME = _object("foxglove.PoseInFrame", timestamp=TIME, frame_id=TEXT, pose=POSE)
SCENE_UPDATE = _object("foxglove.SceneUpdate", deletions=_array(DELETION), entities=_array(ENTITY))
