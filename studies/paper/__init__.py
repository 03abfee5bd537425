"""The paper's claims beside ours, and the effect of conditions that the paper leaves open."""

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
