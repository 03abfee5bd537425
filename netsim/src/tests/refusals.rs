//! Invalid link settings: the error names the problem, its key and the remedy.

use crate::LinkSettings;

/// Error message for settings in JSON.
fn refused(text: &str) -> String {
    let settings: LinkSettings = serde_json::from_str(text).unwrap();
    settings.validate().expect_err(text).to_string()
}

#[test]
fn error_names_key_value_and_remedy() {
    let cases = [
        (r#"{"mtu": 0}"#, "mtu = 0: must be a finite number from 1 to 65535"),
        (
            r#"{"loss": 0.1, "mean_burst": 0.5}"#,
            "mean_burst = 0.5: must be a finite number from 1 to 1000000000",
        ),
        (r#"{"mean_burst": 0.5}"#, "mean_burst = 0.5: must be"),
        (
            r#"{"loss": 0.75, "mean_burst": 2}"#,
            "mean_burst: 2 is too short for loss = 0.75: between two bursts at least one packet passes, so that \
             they last at least 3 packets on average; lengthen them, or lower loss to at most 0.666",
        ),
        (r#"{"loss": 0.1, "mean_burst_s": 1e-9}"#, "mean_burst_s = 0.000000001: must be"),
        (
            r#"{"loss": 0.9, "mean_burst_s": 1e-6}"#,
            "mean_burst_s: 0.000001 is too short for loss = 0.9: give at",
        ),
        (
            r#"{"loss": 0.1, "mean_burst": 2, "mean_burst_s": 1}"#,
            "mean_burst: is a model of loss, and so is mean_burst_s: give one of them",
        ),
        (
            r#"{"loss": 0.1, "gilbert_elliott": {"to_bad": 0.1, "to_good": 0.1}}"#,
            "gilbert_elliott: is a model of loss, and so is loss: give one of them",
        ),
        (
            r#"{"four_state": {"p13": 0, "p31": 1}, "gilbert_elliott": {"to_bad": 0.1, "to_good": 0.1}}"#,
            "gilbert_elliott: is a model of loss, and so is four_state: give one of them",
        ),
        (r#"{"gilbert_elliott": {"to_bad": 2, "to_good": 0}}"#, "gilbert_elliott.to_bad = 2: must be"),
        (
            r#"{"gilbert_elliott": {"to_bad": 0, "to_good": 0}}"#,
            "gilbert_elliott.to_good: is 0, and so is to_bad",
        ),
        (
            r#"{"four_state": {"p13": 0.6, "p31": 1, "p14": 0.5}}"#,
            "four_state.p13: p13 + p14 = 1.1: must be at",
        ),
        (
            r#"{"four_state": {"p13": 0.1, "p31": 0.6, "p32": 0.5}}"#,
            "four_state.p31: p31 + p32 = 1.1: must be at",
        ),
        (r#"{"four_state": {"p13": 0, "p31": 0}}"#, "four_state.p31: what the link settles in depends"),
        (
            r#"{"outages": [{"times": {"kind": "once", "at_s": -1, "duration_s": 1}}]}"#,
            "outages.0.times.at_s = -1: must be a finite number from 0 to 1000000000",
        ),
        (
            r#"{"outages": [{"times": {"kind": "once", "at_s": 0, "duration_s": 1}},
                {"times": {"kind": "periodic", "at_s": 0, "period_s": 1, "duration_s": 1}, "effect": "hold"}]}"#,
            "outages.1.times.duration_s: 1 is not below period_s = 1: nothing would ever pass again",
        ),
        (
            r#"{"outages": [{"times": {"kind": "random", "mean_up_s": 0.001, "mean_down_s": 2}}]}"#,
            "outages.0.times.mean_down_s = 2: must be a finite number from 0.000001 to 1",
        ),
        (r#"{"reorder": -0.1, "delay_s": 1}"#, "reorder = -0.1: must be a finite number from 0 to 1"),
        (
            r#"{"reorder": 0.1}"#,
            "reorder: without a delay no packet is ever under way to be overtaken: give delay_s, or reorder_hold_s",
        ),
        (r#"{"reorder_depth": 1025}"#, "reorder_depth = 1025: must be a finite number from 1 to 1024"),
        (
            r#"{"reorder_depth": 2, "reorder_hold_s": 1}"#,
            "reorder_depth: a packet that is held overtakes none",
        ),
        (r#"{"reorder_hold_s": 0}"#, "reorder_hold_s = 0: must be a finite number from 0.000000001 to 3600"),
        (r#"{"duplicate": 2}"#, "duplicate = 2: must be"),
        (r#"{"duplicate_gap_s": -1}"#, "duplicate_gap_s = -1: must be"),
        (r#"{"corrupt": 1.1}"#, "corrupt = 1.1: must be"),
        (r#"{"corrupt_bits": 0}"#, "corrupt_bits = 0: must be a finite number from 1 to 1024"),
        (r#"{"truncate": -1}"#, "truncate = -1: must be"),
        (r#"{"truncate_bytes": 65536}"#, "truncate_bytes = 65536: must be a finite number from 0 to 65535"),
    ];
    for (text, message) in cases {
        let seen = refused(text);
        assert!(seen.starts_with(message), "{text}\n{seen}");
    }
}

#[test]
fn a_refusal_of_an_attack_names_its_place_in_the_list() {
    let cases = [
        (r#"{"kind": "replay", "after_s": -1}"#, "{}", "action.after_s = -1: must be"),
        (r#"{"kind": "forge", "keep_bytes": 70000}"#, "{}", "action.keep_bytes = 70000: must be"),
        (
            r#"{"kind": "bit-flip", "bits": 1, "within": {"start": 4, "end": 4}}"#,
            "{}",
            "action.within.start: 4 is not below end = 4",
        ),
        (
            r#"{"kind": "bit-flip", "bits": 9, "within": {"start": 4, "end": 5}}"#,
            "{}",
            "action.bits = 9: must be a finite number from 1 to 8",
        ),
        (
            r#"{"kind": "bit-flip", "bits": 1025, "within": {"start": 0, "end": 500}}"#,
            "{}",
            "action.bits = 1025: must be a finite number from 1 to 1024",
        ),
        (r#"{"kind": "sequence-lead", "lead": 0, "offset": 0}"#, "{}", "action.lead = 0: must be"),
        (r#"{"kind": "sequence-lead", "lead": 1, "offset": 65530}"#, "{}", "action.offset = 65530: must be"),
        (r#"{"kind": "hold-back", "by_s": 3601}"#, "{}", "action.by_s = 3601: must be"),
        (r#"{"kind": "alter"}"#, "{}", "action.edits: is empty, and no checksum is put right"),
        (
            r#"{"kind": "alter", "edits": [{"type": "u64", "offset": 65528, "operation": "set", "value": 1}]}"#,
            "{}",
            "action.edits.0.offset = 65528: must be a finite number from 0 to 65527",
        ),
        (
            r#"{"kind": "alter", "edits": [{"type": "u64", "offset": 0, "operation": "set", "value": 1},
                {"type": "f64", "offset": 0, "operation": "add", "value": -2e12}]}"#,
            "{}",
            "action.edits.1.value = -2000000000000: must be a finite number from -1000000000000 to 1000000000000",
        ),
        (r#"{"kind": "drop"}"#, r#"{"every": 0}"#, "target.every = 0: must be"),
        (r#"{"kind": "drop"}"#, r#"{"probability": 2}"#, "target.probability = 2: must be"),
        (r#"{"kind": "drop"}"#, r#"{"from_s": -1}"#, "target.from_s = -1: must be"),
        (
            r#"{"kind": "drop"}"#,
            r#"{"from_s": 2, "until_s": 2}"#,
            "target.until_s: 2 is not after from_s = 2",
        ),
        (
            r#"{"kind": "drop"}"#,
            r#"{"least_bytes": 9, "most_bytes": 8}"#,
            "target.most_bytes: 8 is below least",
        ),
    ];
    for (action, target, message) in cases {
        let text = format!(
            r#"{{"attacks": [{{"action": {{"kind": "mirror"}}}}, {{"action": {action}, "target": {target}}}]}}"#
        );
        let seen = refused(&text);
        assert!(seen.starts_with(&format!("attacks.1.{message}")), "{text}\n{seen}");
    }
}
