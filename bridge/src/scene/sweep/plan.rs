//! Plan of a sweep: rows that a thread runs as one job, and rows that share a part of their runs.

use std::collections::{BTreeMap, HashMap};

use haptether_numeric::of_axes;
use haptether_safety::controller::SafetySettings;
use serde::Deserialize as _;
use serde_json::Value;

use super::{SweepError, SweepPart, Variation};
use crate::scene::{
    shared,
    spec::{SceneSpec, scene_axes},
};

/// Smallest number of scenarios without an arm in a job, and largest number with one.
const BLOCK: usize = 64;

/// Largest number of scenarios that share a beginning.
const MAX_GROUP: usize = 32;

/// Largest number of scenarios that share link and ladders. Their tick takes as long as several ticks of a hand and an
/// arm.
const MAX_CONNECTED: usize = 64;

pub(super) fn bad_axes(axes: usize) -> SweepError {
    SweepError::Scene(format!("master.axes = {axes}: must be 1 to 7"))
}

/// Parsed part of a sweep.
pub(super) struct Plan<'a> {
    pub(super) base: Value,
    pub(super) axes: usize,
    pub(super) rows: usize,
    pub(super) columns: Vec<Column<'a>>,
    /// Tables of the columns, each once, in the order of the columns.
    pub(super) tables: Vec<&'a str>,
}

/// Number of a scene that differs between rows.
pub(super) struct Column<'a> {
    /// Path in the scene: keys and list indices.
    pub(super) keys: Vec<&'a str>,
    /// True if the number is an integer.
    pub(super) is_whole: bool,
    /// Value in each row.
    pub(super) values: &'a [f64],
}

impl Column<'_> {
    /// Return its place in a scene as JSON. A JSON pointer would be split and unescaped again at each row.
    pub(super) fn place<'v>(&self, scene: &'v mut Value) -> Option<&'v mut Value> {
        self.keys.iter().try_fold(scene, |value, key| match value {
            Value::Object(table) => table.get_mut(*key),
            // An index has one spelling, as in a JSON pointer.
            Value::Array(list) if *key == "0" || !key.starts_with(['0', '+']) => {
                list.get_mut(key.parse::<usize>().ok()?)
            }
            _ => None,
        })
    }
}

impl<'a> Plan<'a> {
    pub(super) fn new(part: &SweepPart<'a>) -> Result<Self, SweepError> {
        let unread = |error: serde_json::Error| SweepError::Scene(error.to_string());
        let axes = scene_axes(part.scene).map_err(unread)?;
        if !(1..=7).contains(&axes) {
            return Err(bad_axes(axes));
        }
        let mut base: Value = serde_json::from_slice(part.scene).map_err(unread)?;
        let rows = part.variations.first().map_or(1, |first| first.values.len());
        let (mut columns, mut tables) = (Vec::with_capacity(part.variations.len()), Vec::new());
        for Variation { path, values } in part.variations {
            if values.len() != rows {
                return Err(SweepError::Length { path: path.clone(), seen: values.len(), allowed: rows });
            }
            let mut column = Column { keys: path.split('.').collect(), is_whole: false, values };
            column.is_whole = match column.place(&mut base) {
                Some(Value::Number(number)) => number.is_u64(),
                // Null means no bound, and a row may set one. An absent table has no numbers.
                Some(Value::Null) => false,
                _ => return Err(SweepError::Path(path.clone())),
            };
            let table = column.keys.first().copied().unwrap_or_default();
            if !tables.contains(&table) {
                tables.push(table);
            }
            columns.push(column);
        }
        // Outcomes need no recording.
        base["record"] = Value::Null;
        Ok(Self { base, axes, rows, columns, tables })
    }

    fn is_remote(&self) -> bool {
        self.base.get("slave").is_some_and(|slave| !slave.is_null())
    }

    /// Return true if scenarios that differ only in their controllers may share a beginning.
    fn can_share(&self) -> bool {
        fn of<const N: usize>(base: &Value) -> bool {
            SceneSpec::<N>::deserialize(base).is_ok_and(|scene| shared::can_share(&scene))
        }
        let of = of_axes!(self.axes, N => of::<N>, _axes => return false);
        of(&self.base)
    }

    /// Return the key of scenarios that may share a beginning: the base without controllers, and the deciding paths.
    fn common(&self, of_controllers: &[String]) -> String {
        let mut base = self.base.clone();
        if let Some(safety) = base.get_mut("safety").and_then(Value::as_object_mut) {
            safety.retain(|key, _| !of_controllers.iter().any(|one| one == key));
        }
        let mut paths = String::new();
        for column in self.decisive(of_controllers) {
            if let Some(place) = column.place(&mut base) {
                *place = Value::Null;
            }
            paths = paths + &column.keys.join(".") + " ";
        }
        paths + &base.to_string()
    }

    /// Return the key of scenarios that may share link and ladders.
    fn connection(&self) -> String {
        let mut base = self.base.clone();
        if let Value::Object(tables) = &mut base {
            for (table, value) in tables.iter_mut() {
                if let Value::Object(keys) = value {
                    keys.retain(|key, _| decides_connection(&[table, key]));
                } else if !decides_connection(&[table]) {
                    *value = Value::from(value.is_null());
                }
            }
        }
        let mut paths = String::new();
        for column in self.connective() {
            if let Some(place) = column.place(&mut base) {
                *place = Value::Null;
            }
            paths = paths + &column.keys.join(".") + " ";
        }
        paths + &base.to_string()
    }

    /// Return the columns that decide link and ladders, in a fixed order.
    fn connective(&self) -> Vec<&Column<'a>> {
        let mut found: Vec<_> =
            self.columns.iter().filter(|column| decides_connection(&column.keys)).collect();
        found.sort_by(|one, other| one.keys.cmp(&other.keys));
        found
    }

    /// Return the columns that decide the beginning of a run, in a fixed order.
    fn decisive(&self, of_controllers: &[String]) -> Vec<&Column<'a>> {
        let decides = |column: &&Column<'_>| match column.keys.as_slice() {
            ["safety", key] => !of_controllers.iter().any(|one| one == key),
            _ => true,
        };
        let mut found: Vec<_> = self.columns.iter().filter(decides).collect();
        found.sort_by(|one, other| one.keys.cmp(&other.keys));
        found
    }
}

/// Return true if the value at `keys` may decide link and ladders.
///
/// Scenes are compared before they share. A key too many reduces sharing; a missing key costs a comparison.
fn decides_connection(keys: &[&str]) -> bool {
    match keys {
        ["run" | "link" | "security", ..] => true,
        ["slave", key, ..] => *key == "period_s",
        ["safety", key, ..] => *key == "ladder",
        ["operator", key, ..] => key.starts_with("clutch"),
        ["master", key, ..] => matches!(*key, "kind" | "axes" | "buttons"),
        _ => false,
    }
}

/// Return the keys of `[safety]` that select and configure controllers.
fn controller_keys() -> Vec<String> {
    let schema = schemars::schema_for!(SafetySettings);
    let fields = schema.get("properties").and_then(Value::as_object);
    fields.map(|fields| fields.keys().cloned().collect()).unwrap_or_default()
}

/// Part and row.
pub(super) type Place = (usize, usize);

/// Work that a thread does at one time.
pub(super) enum Job {
    /// Rows of a part.
    Block(usize, std::ops::Range<usize>),
    /// Number of axes, and groups of rows. The rows of a group share a beginning, or link and ladders.
    Groups(usize, Vec<Vec<Place>>),
}

impl Job {
    pub(super) fn places(&self) -> Vec<Place> {
        match self {
            Self::Block(part, rows) => rows.clone().map(|row| (*part, row)).collect(),
            Self::Groups(_, groups) => groups.concat(),
        }
    }
}

pub(super) fn jobs(plans: &[Plan<'_>], threads: usize, has_research: bool) -> Vec<Job> {
    let mut jobs = Vec::new();
    // Grouped by number of axes, in the order of their first rows.
    let mut groups = BTreeMap::<usize, Vec<Vec<Place>>>::new();
    let of_controllers = controller_keys();
    // The rows of a group run one after the other. Groups are small enough that every thread has one.
    let rows: usize = plans.iter().map(|plan| plan.rows).sum();
    let most = rows.div_ceil(2 * threads).clamp(1, MAX_GROUP);
    let (mut beginnings, mut connections) = (Keys::default(), Keys::default());
    // Rows of each connection, each with its beginning.
    let mut connected = Vec::<(usize, Vec<(usize, Place)>)>::new();
    for (part, plan) in plans.iter().enumerate() {
        if has_research || !plan.is_remote() || !plan.can_share() {
            let size = if plan.is_remote() {
                block_size(plan.rows, threads)
            } else {
                local_size(plan.rows, threads)
            };
            let blocks = (0..plan.rows).step_by(size);
            jobs.extend(blocks.map(|first| Job::Block(part, first..plan.rows.min(first + size))));
            continue;
        }
        let beginning = beginnings.common(plan.common(&of_controllers));
        let connection = connections.common(plan.connection());
        let (decisive, connective) = (plan.decisive(&of_controllers), plan.connective());
        for row in 0..plan.rows {
            let beginning = beginnings.of(beginning, &decisive, row);
            let connection = connections.of(connection, &connective, row);
            if connection == connected.len() {
                connected.push((plan.axes, Vec::new()));
            }
            connected[connection].1.push((beginning, (part, row)));
        }
    }
    for (axes, rows) in connected {
        let of_axes = groups.entry(axes).or_default();
        let is_one_beginning = rows.iter().all(|(beginning, _)| *beginning == rows[0].0);
        let size = if is_one_beginning { most } else { rows.len().div_ceil(threads).clamp(1, MAX_CONNECTED) };
        of_axes.extend(rows.chunks(size).map(|some| some.iter().map(|(_, place)| *place).collect()));
    }
    for (axes, groups) in groups {
        let size = block_size(groups.iter().map(Vec::len).sum(), threads);
        let mut some: Vec<Vec<Place>> = Vec::new();
        for group in groups {
            some.push(group);
            if some.iter().map(Vec::len).sum::<usize>() >= size {
                jobs.push(Job::Groups(axes, std::mem::take(&mut some)));
            }
        }
        if !some.is_empty() {
            jobs.push(Job::Groups(axes, some));
        }
    }
    jobs
}

/// Numbers of shared keys, in the order in which they are found.
#[derive(Default)]
struct Keys {
    commons: HashMap<String, usize>,
    known: HashMap<(usize, Vec<u64>), usize>,
}

impl Keys {
    /// Return the number of a key that all rows of a part share.
    fn common(&mut self, common: String) -> usize {
        let next = self.commons.len();
        *self.commons.entry(common).or_insert(next)
    }

    /// Return the number of a key that rows share: the key of their part, and their values in `columns`.
    fn of(&mut self, common: usize, columns: &[&Column<'_>], row: usize) -> usize {
        let key = columns.iter().map(|column| column.values[row].to_bits()).collect();
        let next = self.known.len();
        *self.known.entry((common, key)).or_insert(next)
    }
}

/// Return the rows per job without an arm. The runs are mostly short: one reading of the scene serves many rows, and
/// each thread has about eight jobs.
fn local_size(rows: usize, threads: usize) -> usize {
    rows.div_ceil(8 * threads).clamp(BLOCK, 16 * BLOCK)
}

/// Return the rows per job with an arm. A run takes milliseconds: small blocks keep all threads busy to the end.
fn block_size(rows: usize, threads: usize) -> usize {
    rows.div_ceil(8 * threads).clamp(1, BLOCK)
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Rows have the same outcomes whether they share or not, so only this test detects missing groups.
    #[test]
    fn rows_that_differ_in_controllers_form_a_group() {
        let scene: Value = serde_json::from_slice(include_bytes!("../../../tests/remote_push.json")).unwrap();
        let with = |controllers: &[&str], corrupt: f64| {
            let mut scene = scene.clone();
            scene["safety"]["controllers"] = controllers.into();
            scene["link"]["forward"]["loss"] = corrupt.into();
            serde_json::to_vec(&scene).unwrap()
        };
        let scenes = [with(&[], 0.01), with(&["wsc"], 0.01), with(&["hsc"], 0.02)];
        let column = |path: &str, values: &[f64]| Variation { path: path.into(), values: values.to_vec() };
        let variations = [column("run.seed", &[1.0, 2.0, 1.0]), column("safety.window", &[50.0, 60.0, 70.0])];
        let parts = scenes.each_ref().map(|scene| SweepPart { scene, variations: &variations });
        let plans = parts.each_ref().map(|part| Plan::new(part).unwrap());
        let groups = |threads: usize, has_research: bool| {
            let jobs = jobs(&plans, threads, has_research);
            let rows: usize = jobs.iter().map(|job| job.places().len()).sum();
            assert_eq!(rows, 9);
            let of = |job: Job| if let Job::Groups(1, groups) = job { groups } else { Vec::new() };
            jobs.into_iter().flat_map(of).collect::<Vec<_>>()
        };
        let expected =
            [vec![(0, 0), (0, 2), (1, 0), (1, 2)], vec![(0, 1), (1, 1)], vec![(2, 0), (2, 2)], vec![(2, 1)]];
        assert_eq!(groups(1, false), expected);
        assert!(groups(1, true).is_empty());
        // With more threads, groups are smaller, so that no thread is idle.
        assert!(groups(4, false).iter().all(|group| group.len() <= 2));
    }

    #[test]
    fn rows_with_equal_link_and_ladders_form_a_group() {
        let scene = include_bytes!("../../../tests/remote_push.json");
        let column = |path: &str, values: &[f64]| Variation { path: path.into(), values: values.to_vec() };
        let hands = [column("operator.stiffness", &[200.0, 300.0, 400.0, 500.0, 600.0])];
        let delays =
            [column("link.forward.delay_s", &[0.05, 0.06, 0.05]), column("slave.mass_kg", &[1.0, 2.0, 3.0])];
        let seeds = [column("operator.damping", &[5.0, 6.0]), column("run.seed", &[1.0, 2.0])];
        let parts = [&hands[..], &delays, &seeds].map(|variations| SweepPart { scene, variations });
        let plans = parts.each_ref().map(|part| Plan::new(part).unwrap());
        let groups = |threads: usize| {
            let of = |job: Job| if let Job::Groups(1, groups) = job { groups } else { Vec::new() };
            jobs(&plans, threads, false).into_iter().flat_map(of).collect::<Vec<_>>()
        };
        let all: Vec<Place> = (0..5).map(|row| (0, row)).collect();
        let others = [vec![(1, 0), (1, 2)], vec![(1, 1)], vec![(2, 0)], vec![(2, 1)]];
        assert_eq!(groups(1), [std::slice::from_ref(&all), &others[..]].concat());
        let halves = [vec![(1, 0)], vec![(1, 2)], vec![(1, 1)], vec![(2, 0)], vec![(2, 1)]];
        assert_eq!(groups(2), [&[all[..3].to_vec(), all[3..].to_vec()], &halves[..]].concat());
    }

    /// A misspelled key would only cost comparisons, so each key is looked up in a scene.
    #[test]
    fn keys_that_decide_the_connection_exist() {
        let scene: Value = serde_json::from_slice(include_bytes!("../../../tests/remote_push.json")).unwrap();
        for (keys, decides) in [
            (&["run", "seed"][..], true),
            (&["link", "backward", "loss"], true),
            (&["slave", "period_s"], true),
            (&["slave", "bandwidth_hz"], false),
            (&["safety", "ladder", "hold_after_s"], true),
            (&["safety", "window"], false),
            (&["operator", "clutch_reaction_s"], true),
            (&["operator", "stiffness"], false),
            (&["master", "mass_kg", "0"], false),
            (&["environment", "objects", "0", "contact", "stiffness"], false),
        ] {
            let found = keys.iter().try_fold(&scene, |value, key| match value {
                Value::Array(list) => list.get(key.parse::<usize>().ok()?),
                value => value.get(*key),
            });
            assert!(found.is_some_and(Value::is_number), "{keys:?}");
            assert_eq!(decides_connection(keys), decides, "{keys:?}");
        }
    }

    /// With one thread, a scene is read once for many short runs; with many threads, each has a job.
    #[test]
    fn jobs_of_short_runs_keep_all_threads_busy() {
        for (rows, threads, size) in
            [(1, 1, BLOCK), (500, 1, BLOCK), (10_000, 1, 1024), (10_000, 2, 625), (10_000, 64, BLOCK)]
        {
            assert_eq!(local_size(rows, threads), size, "{rows} {threads}");
        }
    }

    #[test]
    fn path_resolves_like_a_json_pointer() {
        let mut scene = serde_json::json!({
            "a": {"b": [1.0, {"c": 2.0}], "": 3.0, "x~1y": 4.0, "x/y": 5.0}, "0": 6.0
        });
        for path in [
            "a.b.0", "a.b.1.c", "a.b.2", "a.b.00", "a.b.+1", "a.b.-1", "a.b.", "a.", "a.b.1.d", "0", "00",
            "", "a.b.0.c",
        ] {
            let column = Column { keys: path.split('.').collect(), is_whole: false, values: &[] };
            let pointer = format!("/{}", path.replace('.', "/"));
            let expected = scene.pointer(&pointer).cloned();
            assert_eq!(column.place(&mut scene).cloned(), expected, "{path}");
        }
        for (key, number) in [("x~1y", 4.0), ("x/y", 5.0)] {
            let column = Column { keys: vec!["a", key], is_whole: false, values: &[] };
            assert_eq!(column.place(&mut scene), Some(&mut Value::from(number)), "a key is not unescaped");
        }
    }
}
