"""Labels of scene fields and metrics for axes, tables and captions: words and a unit, from the docs of the tables."""

import ast
import inspect
import re
from collections.abc import Iterable
from functools import cache
from itertools import pairwise

from haptether.bridge.scene.errors import table_type
from haptether.view.style.labels import AxisLabel

METRICS = {
    "outcome": "outcome",
    "max_ejection_velocity": "largest ejection velocity [m/s]",
    "peak_device_force": "largest device force [N]",
    "time_to_trip_s": "time to trip after the release [s]",
    "false_trips": "interventions while the hand held",
    "intervention_s": "time under intervention [s]",
    "position_rmse_m": "position error, RMS [m]",
    "force_rmse_n": "force error, RMS [N]",
    "max_ejection_rate": "largest angular ejection velocity [rad/s]",
    "peak_device_torque": "largest device torque [N m]",
    "orientation_rmse_rad": "orientation error, RMS [rad]",
    "torque_rmse_n_m": "torque error, RMS [N m]",
    "passivity_min_j": "least energy taken in [J]",
    "diverged": "diverged",
    "ticks": "ticks",
    "wall_time_s": "computed in [s]",
}
"""Labels of the metrics in tables and figures."""

UNIT = re.compile(
    r"\b[Ii]n ((?:kg|rad|bit|ms|Hz|mm|[smNJW])(?:[ /](?:kg|rad|[smNJW][²⁵]?)|²)*|ticks|bytes|degrees)\b(?! *=)"
)
"""Unit in the doc of a field: "V_t of VFC in m/s"."""
SUFFIXES = {
    "_n_m_per_s": "N m/s", "_n_per_s": "N/s", "_kg_m2": "kg m²", "_n_m": "N m", "_rad": "rad", "_ppm": "ppm",
    "_bps": "bit/s", "_bytes": "bytes", "_ticks": "ticks", "_packets": "packets", "_kg": "kg", "_hz": "Hz", "_ms": "ms",
    "_s": "s", "_m": "m", "_n": "N", "_j": "J", "_w": "W",
}  # fmt: skip
"""Units in names of fields, for docs without one; a label has its unit in brackets."""
SILENT = frozenset({"run", "safety", "link", "environment", "rows", "times", "shape"})
"""Tables whose fields are clear without their name."""
WORDS = {
    "hsc": "HSC", "vfc": "VFC", "wsc": "WSC", "pc": "PC", "mtu": "MTU", "coulomb": "Coulomb friction",
    "viscous": "viscous friction", "at": "time", "max": "largest",
}  # fmt: skip


@cache
def _docs(table: type) -> dict[str, str]:
    """Return the docs of a table's fields, the strings below them."""
    (body,) = ast.parse(inspect.getsource(table)).body
    assert isinstance(body, ast.ClassDef)
    found = {}
    for field, doc in zip(body.body, body.body[1:], strict=False):
        if isinstance(field, ast.AnnAssign) and isinstance(field.target, ast.Name) and isinstance(doc, ast.Expr):
            assert isinstance(doc.value, ast.Constant)
            found[field.target.id] = " ".join(str(doc.value.value).split())
    return found


def label_of(name: str) -> AxisLabel:
    """Return the label of a metric, or of a field by its path: `link.forward.delay_s` is the forward delay in s.

    Trailing indices remain: `operator.start.2` is "operator start 2".
    """
    if name in METRICS:
        words, _, unit = METRICS[name].partition(" [")
        return AxisLabel(words, unit.rstrip("]"))
    field = re.fullmatch(r"(.*?)((?:\.\d+)*)", name)
    assert field is not None
    *above, leaf = str(field[1]).split(".")
    path = tuple(int(step) if step.isdigit() else step for step in above)
    docs = [docs[leaf] for table in table_type(path) or () if leaf in (docs := _docs(table.cls))]
    suffix = next((end for end in SUFFIXES if leaf.endswith(end)), "")
    unit = next((found[1] for doc in docs if (found := UNIT.search(doc))), SUFFIXES.get(suffix, ""))
    tables = [re.sub("ies$", "y", step).removesuffix("s") if after.isdigit() else step
              for step, after in pairwise([*above, ""]) if not step.isdigit() and step not in SILENT]  # fmt: skip
    key = f"{'_'.join(tables[-1:])}_{leaf.removesuffix(suffix)}{field[2]}".strip("_").replace(".", "_")
    return AxisLabel(" ".join(WORDS.get(word, word) for word in key.split("_")), unit)


def labels_of(names: Iterable[str]) -> dict[str, AxisLabel]:
    """Return the labels of metrics and fields by name."""
    return {name: label_of(name) for name in names}
