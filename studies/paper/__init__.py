"""The paper's claims beside ours, and what moves ours over what the paper does not tell."""

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
