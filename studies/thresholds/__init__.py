"""Thresholds of safety controllers: false trips per hour and missed releases over round trips."""

from haptether.studies.thresholds.figure import draw_trade_off
from haptether.studies.thresholds.law import THRESHOLD_LAWS, ThresholdLaw
from haptether.studies.thresholds.trade_off import TradeOff, TradeOffPoint, TradeOffRow, measure_thresholds

__all__ = [
    "THRESHOLD_LAWS",
    "ThresholdLaw",
    "TradeOff",
    "TradeOffPoint",
    "TradeOffRow",
    "draw_trade_off",
    "measure_thresholds",
]
