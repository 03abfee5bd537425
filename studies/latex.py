"""LaTeX for a paper: tables and figures whose captions have the command, the version and the sources to cite."""

import math
import re
from collections.abc import Iterable, Sequence
from pathlib import Path

from msgspec import Struct

from haptether import __version__
from haptether.bridge import COUPLINGS, Scene
from haptether.bridge.scene.labels import METRICS, label_of
from haptether.bridge.scene.tables.session import CouplingTable
from haptether.safety import CONTROLLERS, ESTIMATORS
from haptether.studies.sampled import SummaryRow, metric_of
from haptether.view.style.colours import controller_title
from haptether.view.style.labels import wrapped

PAPER = r"\emph{Safety Control for Impedance Haptic Interfaces}, "
"""Work that a source names "paper"."""
ESCAPED = {
    "\\": r"\textbackslash{}", "~": r"\textasciitilde{}", "^": r"\textasciicircum{}", "<": r"\textless{}",
    ">": r"\textgreater{}", "|": r"\textbar{}", "²": r"\textsuperscript{2}", "⁵": r"\textsuperscript{5}",
    "'": r"\textquotesingle{}", "--": "-{}-", "±": r"$\pm$", "\N{MINUS SIGN}": "$-$",
    **{letter: f"\\{letter}" for letter in "&%$#_{}"},
}  # fmt: skip
_SPECIAL = re.compile("|".join(map(re.escape, ESCAPED)))
HEAD = 14
"""Characters of a head on one line."""
LINE_BREAK, SPLIT, MINUS = "\n", r" \\ ", "\N{MINUS SIGN}"
WIDE = 4
"""Columns from which a table spans both columns of a page."""


class LatexCaption(Struct, frozen=True):
    """Caption of a table or figure."""

    text: str
    command: str
    methods: tuple[str, ...] = ()
    """Names of couplings, controllers and estimators."""

    def latex(self) -> str:
        """Return the text, the version, the command, and the source of each method."""
        sources = "; ".join(_source(name) for name in dict.fromkeys(self.methods) if name in _SOURCES)
        return (
            f"{escaped(self.text)} Haptether {__version__}: \\texttt{{{escaped(self.command)}}}."
            f"{f' Sources: {sources}.' if sources else ''}"
        )


_SOURCES = {name: source for registry in (COUPLINGS, CONTROLLERS, ESTIMATORS) for name, _, source in registry}


def escaped(text: str) -> str:
    """Return a text as LaTeX shows it."""
    return _SPECIAL.sub(lambda found: ESCAPED[found[0]], text)


def _source(name: str) -> str:
    title = controller_title(name) if any(name == of for of, _, _ in CONTROLLERS) else name
    source = _SOURCES[name]
    of_paper = source.removeprefix("paper ")
    return f"{escaped(title)}: {PAPER if of_paper != source else ''}{escaped(of_paper)}"


def methods_of(scene: Scene) -> dict[str, tuple[str, ...]]:
    """Return the names of the coupling, the controllers and the estimator of a scene, by field."""
    estimator = None if scene.safety.estimator is None else scene.safety.estimator.__struct_config__.tag
    return {
        "coupling.kind": () if scene.slave is None else ((scene.coupling or CouplingTable()).kind,),
        "safety.controllers": scene.safety.controllers or (),
        "safety.estimator.kind": (estimator,) if isinstance(estimator, str) else (),
    }


def latex_table(head: Sequence[str], rows: Iterable[Sequence[str]], caption: LatexCaption, label: str) -> str:
    """Return a table with the package booktabs; its first column is text, the others are numbers."""
    titles = [rf"\shortstack[{'r' if place else 'l'}]{{{escaped(wrapped(title, HEAD)).replace(LINE_BREAK, SPLIT)}}}"
              for place, title in enumerate(head)]  # fmt: skip
    lines = [" & ".join(cells) + r" \\" for cells in (titles, *(map(escaped, row) for row in rows))]
    place = "table*" if len(head) > WIDE else "table"
    return "\n".join(
        [
            r"% \usepackage{booktabs}", rf"\begin{{{place}}}", r"\centering", r"\footnotesize",
            r"\setlength{\tabcolsep}{3pt}", rf"\caption{{{caption.latex()}}}",
            rf"\label{{tab:{label}}}", rf"\begin{{tabular}}{{l{'r' * (len(head) - 1)}}}", r"\toprule", lines[0],
            r"\midrule", *lines[1:], r"\bottomrule", r"\end{tabular}", rf"\end{{{place}}}", "",
        ]
    )  # fmt: skip


def latex_figure(picture: Path, caption: LatexCaption, label: str, columns: int) -> str:
    """Return a figure one or two columns wide, with the package graphicx."""
    place = "figure" if columns == 1 else "figure*"
    return "\n".join(
        [
            r"% \usepackage{graphicx}", rf"\begin{{{place}}}", r"\centering",
            rf"\includegraphics[width=\linewidth]{{{picture.name}}}", rf"\caption{{{caption.latex()}}}",
            rf"\label{{fig:{label}}}", rf"\end{{{place}}}", "",
        ]
    )  # fmt: skip


def summary_table(summary: Sequence[SummaryRow]) -> tuple[list[str], list[list[str]]]:
    """Return head and rows of a summary: each combination with the mean of each quantity.

    A mean has the larger half of its 95 % interval, a share the interval.
    """
    groups = list(dict.fromkeys(tuple(row.group.items()) for row in summary))
    head, columns = [], []
    for path, _ in groups[0]:
        values = [dict(group)[path] for group in groups]
        number = not any(isinstance(value, str) for value in values)
        text, factor = label_of(path).sized(values if number else [])
        head.append(text if number else label_of(path).words)
        title = controller_title if path == "safety.controllers" else str
        columns.append([f"{value * factor:.6g}" if number else title(value) for value in values])
    for quantity in dict.fromkeys(row.quantity for row in summary):
        rows = {tuple(row.group.items()): row for row in summary if row.quantity == quantity}
        of_means = [(rows[group].mean, rows[group].interval) for group in groups]
        of_differences = [(rows[group].difference, rows[group].difference_interval) for group in groups]
        for words, pairs in (("", of_means), ("difference of ", of_differences)):
            known = [mean for mean, _ in pairs if mean is not None]
            if known or not words:
                text, factor = _of_quantity(quantity, known)
                head.append(f"{words}{text}")
                shape = _mean if quantity in METRICS else _share
                columns.append([shape(mean, interval, factor) for mean, interval in pairs])
    return head, [list(row) for row in zip(*columns, strict=True)]


def _of_quantity(quantity: str, means: list[float]) -> tuple[str, float]:
    """Return the label of a metric or condition, and the factor of its values."""
    if quantity in METRICS:
        return label_of(quantity).sized(means)
    name = metric_of(quantity)
    return f"share with {quantity.replace(name, METRICS.get(name, name))}", 1.0


def _mean(mean: float | None, interval: tuple[float, float] | None, factor: float) -> str:
    if mean is None:
        return "-"
    half = 0.0 if interval is None else max(mean - interval[0], interval[1] - mean) * factor
    if half <= 1e-6 * abs(mean * factor):
        return _signed(f"{mean * factor:.4g}")
    places = max(0, 1 - math.floor(math.log10(half)))
    return _signed(f"{mean * factor:.{places}f} ± {half:.{places}f}")


def _share(mean: float | None, interval: tuple[float, float] | None, factor: float) -> str:
    if mean is None:
        return "-"
    beside = "" if interval is None else f" ({interval[0] * factor:.2g} to {interval[1] * factor:.2g})"
    return _signed(f"{mean * factor:.3g}{beside}")


def _signed(text: str) -> str:
    return text.replace("-", MINUS)
