"""Studies: applications of the bridge that answer a question."""

from typing import TYPE_CHECKING

from haptether.lazy_names import lazy_names

if TYPE_CHECKING:
    from haptether.studies.demo import (
        DEMO_CONTROLLERS,
        DemoScene,
        draw_demo,
        run_demo,
    )
    from haptether.studies.design import (
        ContactLoop,
        DesignCheck,
        Finding,
        Follower,
        check_at_once,
        check_scene,
        largest_delay_s,
        largest_wall_stiffness,
        scene_loops,
        scene_times,
        stable_delays,
        stable_together,
    )
    from haptether.studies.evaluation import (
        EVALUATED_CONTROLLERS,
        EVALUATED_NETWORKS,
        Evaluation,
        EvaluationCell,
        EvaluationLimits,
        Verdict,
        WorstRelease,
        draw_evaluation,
        evaluation_html,
        evaluation_markdown,
    )
    from haptether.studies.evaluation.evaluate import evaluate
    from haptether.studies.evaluation.matrix import (
        CouplingMatrix,
        PairCell,
        couplings_html,
        couplings_markdown,
        draw_couplings,
        evaluate_couplings,
    )
    from haptether.studies.falsifier import Falsified, Release, ReleaseBounds, falsify
    from haptether.studies.follow import FOLLOW_CONTROLLERS, FollowResult, FollowScene, draw_follow, run_follow
    from haptether.studies.link_summary import LinkSummary, LinkVerdict, judge_link, summarise_link
    from haptether.studies.operator import Operator
    from haptether.studies.paper import (
        Explanation,
        JointFit,
        PaperReport,
        PaperRow,
        Sensitivity,
        paper_sensitivity,
        reproduce_paper,
    )
    from haptether.studies.paper.figures import draw_paper
    from haptether.studies.pick import PickResult, PickScene, draw_pick, run_pick
    from haptether.studies.processes import Interrupted
    from haptether.studies.raven import RavenReport, RavenRow, measure_attack, raven_suite
    from haptether.studies.raven_attacks import RAVEN_ATTACKS, RavenAttack
    from haptether.studies.remote_push import PushResult, measure_push, save_master_trace
    from haptether.studies.sampled import SummaryRow, sweep_summary
    from haptether.studies.task import THRESHOLD_TASKS, HandBounds, Network, network_of
    from haptether.studies.thresholds import (
        THRESHOLD_LAWS,
        ThresholdLaw,
        TradeOff,
        TradeOffPoint,
        TradeOffRow,
        draw_trade_off,
        measure_thresholds,
    )
    from haptether.studies.tuning import TUNED_FIELDS, Boundary, RocPoint, TunedThreshold, Tuning, draw_tuning
    from haptether.studies.tuning.tune import tune

__all__ = [
    "DEMO_CONTROLLERS",
    "EVALUATED_CONTROLLERS",
    "EVALUATED_NETWORKS",
    "FOLLOW_CONTROLLERS",
    "RAVEN_ATTACKS",
    "THRESHOLD_LAWS",
    "THRESHOLD_TASKS",
    "TUNED_FIELDS",
    "Boundary",
    "ContactLoop",
    "CouplingMatrix",
    "DemoScene",
    "DesignCheck",
    "Evaluation",
    "EvaluationCell",
    "EvaluationLimits",
    "Explanation",
    "Falsified",
    "Finding",
    "FollowResult",
    "FollowScene",
    "Follower",
    "HandBounds",
    "Interrupted",
    "JointFit",
    "LinkSummary",
    "LinkVerdict",
    "Network",
    "Operator",
    "PairCell",
    "PaperReport",
    "PaperRow",
    "PickResult",
    "PickScene",
    "PushResult",
    "RavenAttack",
    "RavenReport",
    "RavenRow",
    "Release",
    "ReleaseBounds",
    "RocPoint",
    "Sensitivity",
    "SummaryRow",
    "ThresholdLaw",
    "TradeOff",
    "TradeOffPoint",
    "TradeOffRow",
    "TunedThreshold",
    "Tuning",
    "Verdict",
    "WorstRelease",
    "check_at_once",
    "check_scene",
    "couplings_html",
    "couplings_markdown",
    "draw_couplings",
    "draw_demo",
    "draw_evaluation",
    "draw_follow",
    "draw_paper",
    "draw_pick",
    "draw_trade_off",
    "draw_tuning",
    "evaluate",
    "evaluate_couplings",
    "evaluation_html",
    "evaluation_markdown",
    "falsify",
    "judge_link",
    "largest_delay_s",
    "largest_wall_stiffness",
    "measure_attack",
    "measure_push",
    "measure_thresholds",
    "network_of",
    "paper_sensitivity",
    "raven_suite",
    "reproduce_paper",
    "run_demo",
    "run_follow",
    "run_pick",
    "save_master_trace",
    "scene_loops",
    "scene_times",
    "stable_delays",
    "stable_together",
    "summarise_link",
    "sweep_summary",
    "tune",
]

if not TYPE_CHECKING:  # otherwise a type checker would accept any name
    __getattr__, __dir__ = lazy_names(__name__)
