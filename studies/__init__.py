"""Studies: what uses the bridge to answer a question."""

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
        check_scene,
        largest_delay_s,
        largest_wall_stiffness,
        scene_loops,
        scene_times,
        stable_delays,
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
        evaluate,
        evaluation_html,
        evaluation_markdown,
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
    from haptether.studies.task import THRESHOLD_TASKS, HandBounds, Network
    from haptether.studies.thresholds import (
        THRESHOLD_LAWS,
        ThresholdLaw,
        TradeOff,
        TradeOffPoint,
        TradeOffRow,
        draw_trade_off,
        measure_thresholds,
    )

__all__ = [
    "DEMO_CONTROLLERS",
    "EVALUATED_CONTROLLERS",
    "EVALUATED_NETWORKS",
    "FOLLOW_CONTROLLERS",
    "RAVEN_ATTACKS",
    "THRESHOLD_LAWS",
    "THRESHOLD_TASKS",
    "ContactLoop",
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
    "Sensitivity",
    "ThresholdLaw",
    "TradeOff",
    "TradeOffPoint",
    "TradeOffRow",
    "Verdict",
    "WorstRelease",
    "check_scene",
    "draw_demo",
    "draw_evaluation",
    "draw_follow",
    "draw_paper",
    "draw_pick",
    "draw_trade_off",
    "evaluate",
    "evaluation_html",
    "evaluation_markdown",
    "falsify",
    "judge_link",
    "largest_delay_s",
    "largest_wall_stiffness",
    "measure_attack",
    "measure_push",
    "measure_thresholds",
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
    "summarise_link",
]

if not TYPE_CHECKING:  # else any name would do
    __getattr__, __dir__ = lazy_names(
        __name__,
        {
            "demo": (
                "DEMO_CONTROLLERS",
                "DemoScene",
                "draw_demo",
                "run_demo",
            ),
            "design": (
                "ContactLoop",
                "DesignCheck",
                "Finding",
                "Follower",
                "check_scene",
                "largest_delay_s",
                "largest_wall_stiffness",
                "scene_loops",
                "scene_times",
                "stable_delays",
            ),
            "evaluation": (
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
            ),
            "falsifier": ("Falsified", "Release", "ReleaseBounds", "falsify"),
            "follow": (
                "FOLLOW_CONTROLLERS",
                "FollowResult",
                "FollowScene",
                "draw_follow",
                "run_follow",
            ),
            "link_summary": (
                "LinkSummary",
                "LinkVerdict",
                "judge_link",
                "summarise_link",
            ),
            "operator": ("Operator",),
            "paper": (
                "Explanation",
                "JointFit",
                "PaperReport",
                "PaperRow",
                "Sensitivity",
                "paper_sensitivity",
                "reproduce_paper",
            ),
            "paper.figures": ("draw_paper",),
            "pick": (
                "PickResult",
                "PickScene",
                "draw_pick",
                "run_pick",
            ),
            "processes": ("Interrupted",),
            "raven": (
                "RavenReport",
                "RavenRow",
                "measure_attack",
                "raven_suite",
            ),
            "raven_attacks": (
                "RAVEN_ATTACKS",
                "RavenAttack",
            ),
            "remote_push": (
                "PushResult",
                "measure_push",
                "save_master_trace",
            ),
            "task": ("THRESHOLD_TASKS", "HandBounds", "Network"),
            "thresholds": (
                "THRESHOLD_LAWS",
                "ThresholdLaw",
                "TradeOff",
                "TradeOffPoint",
                "TradeOffRow",
                "draw_trade_off",
                "measure_thresholds",
            ),
        },
    )
