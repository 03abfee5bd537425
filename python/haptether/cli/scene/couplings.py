"""Tables and JSON of `haptether evaluate --couplings`, and the parts of its JSON that evaluations share."""

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from collections.abc import Sequence

    from rich.console import Console

    from haptether.studies import CouplingMatrix, Evaluation, Network
    from haptether.studies.evaluation.page import Table


def print_couplings(console: "Console", found: "CouplingMatrix") -> None:
    """Print the felt force of each coupling, and its throws and false trips under each controller."""
    from haptether.studies.evaluation.matrix.page import controller_table, felt_table, statements

    _print_table(console, felt_table(found))
    console.print(
        f"\nForce at rest as a share of that of a rigid tool on {found.on_wall}, on the worst of"
        f" {len(found.networks)} networks, without a controller.\n"
    )
    for statement in statements(found):
        console.print(f"- {statement}")
    for refused in found.refused:
        console.print(f"- {refused}")
    if found.evaluations:
        console.print("")
        _print_table(console, controller_table(found))
        console.print(
            "\nLargest round trip up to which no release throws the device, and the highest rate of false trips per"
            " hour held of all round trips, on the worst network."
        )


def _print_table(console: "Console", table: "Table") -> None:
    from haptether.cli.shared.table import Column, Rows

    rows = Rows(table.head[0], *(Column(name, numbers=True) for name in table.head[1:]), gap=1)
    for row in table.rows:
        rows.add(*(cell if isinstance(cell, str) else cell[0] for cell in row))
    console.print(rows)


def couplings_report(found: "CouplingMatrix") -> dict[str, Any]:
    """Return a matrix as JSON: presses of the pair, and cells of the hands with verdicts and intervals."""
    from haptether.studies.evaluation.result import totals

    fields = ("task", "unit", "wall", "couplings", "round_trips_s", "refused", "pairs")
    report: dict[str, Any] = {name: getattr(found, name) for name in fields}
    report["networks"] = network_report(found.networks)
    report["rests_up_to_s"] = {coupling: found.rests_up_to_s(coupling) for coupling in found.couplings}
    report["hands"] = [
        {
            "coupling": coupling,
            "limits": evaluation.limits,
            "verdicts": verdict_report(evaluation),
            "unthrown_up_to_s": {of: evaluation.unthrown_up_to_s(of) for of in evaluation.controllers},
            "safe_up_to_s": {of: evaluation.safe_up_to_s(of) for of in evaluation.controllers},
            "cells": [
                {
                    "verdict": cell.verdict(evaluation.limits),
                    "false_trips_per_h": totals([cell]).false_trips_per_h,
                    "cell": cell,
                }
                for cell in evaluation.cells
            ],
        }
        for coupling, evaluation in found.evaluations.items()
    ]
    return report


def verdict_report(found: "Evaluation") -> list[dict[str, Any]]:
    """Return the verdict of each controller set at each round trip."""
    return [
        {
            "controllers": controllers,
            "round_trip_s": round_trip_s,
            "verdict": found.verdict(cells),
            "confirmed": found.is_confirmed(cells),
            "hands_needed": found.hands_needed(cells) if found.verdict(cells) == "safe" else None,
        }
        for controllers in found.controllers
        for round_trip_s in found.round_trips_s
        for cells in [found.of(controllers=controllers, round_trip_s=round_trip_s)]
    ]


def network_report(networks: "Sequence[Network]") -> list[dict[str, Any]]:
    """Return networks without the numbers of recordings."""
    names = ("name", "jitter", "loss", "mean_burst", "title", "own_delay_s")
    return [{name: getattr(network, name) for name in names} for network in networks]
