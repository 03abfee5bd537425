"""Colours of everything drawn, on a light ground."""

GROUND = "#f7f8fa"
INK = "#1d2733"
FAINT_INK = "#66727f"
LINE = "#c9d0d8"

DEVICE = "#4c6a8a"
HAND = "#e3b594"
TOOL = "#3b4754"
ARM = "#b9c3cd"
JOINT = "#6f93b5"
GHOST = "#f2a33a"
OBJECT = "#d8cbb3"
FLOOR = "#f4f5f7"
HELD = "#8fb573"
CONTACT = "#d62839"
WORKSPACE = "#aab5c0"

ENVIRONMENT_FORCE = "#d9542b"
DEVICE_FORCE = "#1769c9"
HAND_FORCE = "#8a3fa8"
SAFETY_FORCE = "#1a936f"

MEASURED = "#22577a"
COMMANDED = "#f2a33a"

LADDER = {
    "disengaged": "#c3cad2",
    "aligning": "#f0c808",
    "engaged": "#6bbf8a",
    "stale": "#f4a259",
    "hold": "#ee6c4d",
    "stop": "#b5352c",
    "fault": "#6d1a36",
}
TRIP = "#d62839"

SIGNS = (ENVIRONMENT_FORCE, DEVICE_FORCE, HAND_FORCE, SAFETY_FORCE, MEASURED, COMMANDED, CONTACT, *LADDER.values())
"""Colours that carry meaning, however few pixels they cover."""
