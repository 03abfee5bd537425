//! Settings are read from the tables of a scene and give the described objects.

#![cfg(feature = "serde")]
#![allow(clippy::unwrap_used)]

use haptether_slave::{
    ArmSettings, Axes, ForceSensor, Object, ObjectSettings, PushShape, Pusher, PusherSettings, Shape,
};
use serde::de::DeserializeOwned;

fn from<T: DeserializeOwned>(text: &str) -> Result<T, String> {
    serde_json::from_str(text).map_err(|error| error.to_string())
}

const ARM: &str = r#"{"control": "pd", "mass_kg": 4.0, "bandwidth_hz": 15.0, "stiffness": 900.0, "damping": 60.0,
    "max_speed": 1.0, "max_acceleration": null, "takes_force": false, "viscous": 0.0,
    "max_force_n": 50.0, "max_torque_nm": 5.0, "period_s": 0.002, "position": [0.1, 0.0],
    "force_sensor": {"noise_n": 0.1, "bias_n": [0.5, -0.5], "quantum_n": 0.01, "rate_hz": null}}"#;

#[test]
fn an_arm_and_its_sensor() {
    let arm: ArmSettings<2> = from(ARM).unwrap();
    assert_eq!(arm.model().unwrap().mass_kg(), 4.0);
    let sensor = arm.force_sensor.unwrap();
    let expected = ForceSensor::new(0.1, Axes::<2>::new(0.5, -0.5), 0.01, None, 3).unwrap();
    assert_eq!(sensor.sensor(3).unwrap(), expected);
    for axes in [from::<ArmSettings<1>>(ARM).err(), from::<ArmSettings<3>>(ARM).err()] {
        assert!(axes.unwrap().contains("invalid length"));
    }
    for (key, other) in [("\"mass_kg\"", "\"mass\""), ("\"pd\"", "\"Pd\""), ("\"period_s\": 0.002,", "")] {
        assert!(from::<ArmSettings<2>>(&ARM.replace(key, other)).is_err(), "{key}");
    }
}

fn object(shape: &str, law: &str, motion: &str, body: &str) -> Result<ObjectSettings<1>, String> {
    let contact = format!(
        r#"{{"law": "{law}", "stiffness": 500.0, "damping": 2.0, "exponent": 1.5, "friction": 0.0}}"#
    );
    from(&format!(r#"{{"shape": {shape}, "contact": {contact}, "motion": {motion}, "body": {body}}}"#))
}

#[test]
fn objects_of_every_kind() {
    let motion =
        r#"{"velocity": [0.1], "from_s": 1.0, "until_s": 2.0, "amplitude": [0.0], "frequency_hz": 0.0}"#;
    let body = r#"{"mass_kg": 2.0, "viscous": 1.0, "coulomb": 0.0, "velocity": [0.0]}"#;
    let shapes = [
        r#"{"kind": "plane", "point": [0.2], "normal": [-4.0]}"#,
        r#"{"kind": "sphere", "centre": [0.2], "radius": 0.1}"#,
        r#"{"kind": "box", "centre": [0.2], "half_extents": [0.1]}"#,
        r#"{"kind": "spring", "anchor": [0.2]}"#,
    ];
    for shape in shapes {
        for (motion, body) in [("null", "null"), (motion, "null"), ("null", body)] {
            let built: Object<1> = object(shape, "kelvin-voigt", motion, body).unwrap().object().unwrap();
            assert_eq!(built.body().is_some(), body != "null");
            assert_eq!(built.shape().reference()[0], 0.2);
        }
    }
    let plane: Object<1> = object(shapes[0], "hunt-crossley", "null", "null").unwrap().object().unwrap();
    let expected = Shape::plane(Axes::<1>::new(0.2), Axes::<1>::new(-1.0)).unwrap();
    assert_eq!(plane.shape(), &expected);
    assert_eq!(plane.contact().normal_force(0.01, 0.0), 500.0 * 0.01_f64.powf(1.5));
    let both = object(shapes[0], "kelvin-voigt", motion, body).unwrap().object();
    assert!(both.unwrap_err().to_string().contains("not both"));
    assert!(object(r#"{"kind": "torus", "centre": [0.2]}"#, "kelvin-voigt", "null", "null").is_err());
    assert!(
        object(r#"{"kind": "spring", "anchor": [0.2], "radius": 1.0}"#, "kelvin-voigt", "null", "null")
            .is_err()
    );
}

#[test]
fn pushes_of_every_course() {
    let pusher = |shape: &str, recorded: &str| {
        let numbers =
            r#""at_s": 1.0, "duration_s": 0.5, "rise_s": 0.2, "frequency_hz": 2.0, "force_n": [3.0]"#;
        let text = format!(r#"{{"shape": "{shape}", {numbers}, "recorded": {recorded}}}"#);
        from::<PusherSettings<1>>(&text).unwrap().pusher()
    };
    for (name, shape) in [
        ("step", PushShape::Step),
        ("ramp", PushShape::Ramp { rise_s: 0.2 }),
        ("half-sine", PushShape::HalfSine),
        ("sine", PushShape::Sine { frequency_hz: 2.0 }),
    ] {
        let expected = Pusher::shaped(shape, 1.0, 0.5, Axes::<1>::new(3.0)).unwrap();
        assert_eq!(pusher(name, "null").unwrap(), expected);
    }
    let recorded = pusher("recorded", r#"{"time_s": [0.0, 0.2], "values": [[1.0], [3.0]]}"#).unwrap();
    assert!((recorded.force(1.1)[0] - 2.0).abs() < 1e-12);
    assert!(pusher("recorded", "null").is_err());
}
