"""Report of `haptether paper`: one claim per row, our value, and its sensitivity."""

from typing import Literal

import msgspec

from haptether.studies.operator import Operator

AGREES = 0.1
"""Relative deviation that counts as agreement: twice the reading error of a printed figure."""

Change = dict[str, float | str]
"""Changed factor values by factor name."""


class Explanation(msgspec.Struct, frozen=True, kw_only=True):
    """Run that meets the paper's number: its change, also as text, and its value."""

    change: Change
    text: str
    ours: float


class Sensitivity(msgspec.Struct, frozen=True, kw_only=True):
    """Range of one row over the unstated conditions.

    `least` and `greatest` cover all runs of the design. `by_factor` has both for each single factor; `most_by` names
    the factor with the largest range, null if none affects the row. `explanations` are runs that meet the paper's
    number, one per factor, nearest first; runs with several factors appear only if no single factor suffices. They are
    empty if the declared run agrees. `nearest` is the run nearest to the paper's number. A run with a trip before the
    release is void and not counted.
    """

    least: float | None
    greatest: float | None
    by_factor: dict[str, tuple[float, float]]
    most_by: str | None
    explanations: list[Explanation]
    nearest: Explanation | None

    @property
    def verdict(self) -> str:
        """Return the verdict of a row that does not agree as declared."""
        if self.explanations:
            first = self.explanations[0]
            return f"explained by {first.text}: {first.ours:.3g}"
        if self.nearest is None:
            return "not explained"
        joint = " at " if self.nearest.change else ", "
        return f"not explained: nearest {self.nearest.ours:.3g}{joint}{self.nearest.text}"


class PaperRow(msgspec.Struct, frozen=True, kw_only=True):
    """One claim.

    `relation` is "=" for a value, "<" and ">" for a bound. The conditions (`controller`, `window`, `stiffness`,
    `depth`, `amplitude_n`, `force_threshold_n`) are null if not applicable or default. `paper` is null if the paper
    plots a curve without a number. `says_nothing` is the reason why our value does not answer the claim. `sensitivity`
    is null until `paper_sensitivity` computes it.
    """

    source: str
    quantity: str
    controller: str | None = None
    window: int | None = None
    stiffness: float | None = None
    depth: float | None = None
    amplitude_n: float | None = None
    force_threshold_n: float | None = None
    paper: float | None
    relation: Literal["=", "<", ">"] = "="
    ours: float | None
    unit: str
    note: str = ""
    says_nothing: str = ""
    sensitivity: Sensitivity | None = None

    @property
    def difference(self) -> float | None:
        """Return our value divided by the paper's, minus one; None if not comparable."""
        return self.difference_of(self.ours)

    def difference_of(self, value: float | None) -> float | None:
        """Return `difference` for another value in `unit`."""
        if self.paper is None or value is None or self.paper == 0.0:
            return None
        return value / self.paper - 1.0

    def meets(self, value: float | None) -> bool:
        """Return True if a value agrees with the paper: within 10 % of its number, or within its bound."""
        if self.paper is None or value is None:
            return False
        if self.relation != "=":
            return value < self.paper if self.relation == "<" else value > self.paper
        difference = self.difference_of(value)
        return value == self.paper if difference is None else abs(difference) <= AGREES

    @property
    def paper_inside(self) -> bool | None:
        """Return True if the paper's number is within our range; None without both, or if nothing affects ours."""
        if self.paper is None or (of := self.sensitivity) is None or of.least is None or of.greatest is None:
            return None
        if of.most_by is None:
            return None
        if self.relation == "=":
            return of.least <= self.paper <= of.greatest
        return self.meets(of.least if self.relation == "<" else of.greatest)

    @property
    def verdict(self) -> str:
        """Return the verdict of the row; empty if the paper has no number.

        - "agrees: +3%", "holds" (a bound);
        - "says nothing: tripped before the release";
        - "differs: +11%", "differs: bound not kept", "differs: not seen", while the sensitivity is unknown;
        - "explained by release time 80 ms: 0.0466", "not explained: nearest 0.62 at release time 100 ms".
        """
        if self.paper is None:
            return ""
        if self.says_nothing:
            return f"says nothing: {self.says_nothing}"
        if self.meets(self.ours):
            return "holds" if self.relation != "=" or self.difference is None else f"agrees: {self.difference:+.0%}"
        return self._deviation() if self.sensitivity is None else self.sensitivity.verdict

    def _deviation(self) -> str:
        if self.ours is None:
            return "differs: not seen"
        if self.relation != "=":
            return "differs: bound not kept"
        return "differs" if self.difference is None else f"differs: {self.difference:+.0%}"


class JointFit(msgspec.Struct, frozen=True, kw_only=True):
    """Run of the design that meets most numbers of an experiment at once.

    `experiment` is "all", a figure (Fig. 8 with the controller) or Table 1. Out of its `rows` numbers, `declared` are
    met as declared and `met` with `change`.
    """

    experiment: str
    change: Change
    text: str
    met: int
    declared: int
    rows: int


class PaperReport(msgspec.Struct, frozen=True, kw_only=True):
    """Operator of all rows, device, and rows.

    `joint_fits` come from `paper_sensitivity`, all rows first.
    """

    operator: Operator
    device: dict[str, float]
    rows: list[PaperRow]
    joint_fits: list[JointFit] = []

    def as_json(self) -> bytes:
        """Return the report as JSON, each row with its verdict."""
        rows = [
            {**msgspec.to_builtins(row), "paper_inside": row.paper_inside, "verdict": row.verdict} for row in self.rows
        ]
        report = {"operator": self.operator, "device": self.device, "joint_fits": self.joint_fits, "rows": rows}
        return msgspec.json.format(msgspec.json.encode(report), indent=2)
