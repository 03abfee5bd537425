"""Comparison with the paper's claims, and sensitivity to unstated conditions."""

from haptether.studies.paper.claims import reproduce_paper
from haptether.studies.paper.report import Explanation, JointFit, PaperReport, PaperRow, Sensitivity
from haptether.studies.paper.sensitivity import paper_sensitivity

__all__ = [
    "Explanation",
    "JointFit",
    "PaperReport",
    "PaperRow",
    "Sensitivity",
    "paper_sensitivity",
    "reproduce_paper",
]
