"""Safety of a set-up: controllers over round trips and networks, in tasks by many hands."""

from haptether.studies.evaluation.evaluate import evaluate
from haptether.studies.evaluation.figure import draw_evaluation
from haptether.studies.evaluation.page import evaluation_html, evaluation_markdown
from haptether.studies.evaluation.result import (
    EVALUATED_CONTROLLERS,
    EVALUATED_NETWORKS,
    Evaluation,
    EvaluationCell,
    EvaluationLimits,
    Verdict,
    WorstRelease,
)

__all__ = [
    "EVALUATED_CONTROLLERS",
    "EVALUATED_NETWORKS",
    "Evaluation",
    "EvaluationCell",
    "EvaluationLimits",
    "Verdict",
    "WorstRelease",
    "draw_evaluation",
    "evaluate",
    "evaluation_html",
    "evaluation_markdown",
]
