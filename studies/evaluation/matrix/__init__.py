"""Matrix of couplings, controllers and networks."""

from haptether.studies.evaluation.matrix.figure import draw_couplings
from haptether.studies.evaluation.matrix.measure import (
    COUPLING_NAMES,
    CouplingMatrix,
    Median,
    PairCell,
    evaluate_couplings,
)
from haptether.studies.evaluation.matrix.page import couplings_html, couplings_markdown

__all__ = [
    "COUPLING_NAMES",
    "CouplingMatrix",
    "Median",
    "PairCell",
    "couplings_html",
    "couplings_markdown",
    "draw_couplings",
    "evaluate_couplings",
]
