//! Arguments of `tc netem`.

use std::str::FromStr;

use crate::checks::{LinkSettingsError, MAX_DELAY_S};
use crate::impairments::ParseError;

const DEFAULT_LIMIT: usize = 1000;
const MAX_PACKETS: usize = 10_000_000;
const MAX_TEXT_BYTES: usize = 4096;

/// Arguments that `tc` passes to netem. As in `tc`, probabilities and correlations are in units of 2^-32 - 1.
#[derive(Clone, Debug, PartialEq)]
pub(super) struct Arguments {
    pub(super) limit: usize,
    pub(super) latency_ns: i64,
    pub(super) jitter_ns: i64,
    pub(super) delay_rho: u32,
    pub(super) table: Table,
    pub(super) loss: Loss,
    pub(super) duplicate: Chance,
    pub(super) corrupt: Chance,
    pub(super) reorder: Chance,
    pub(super) gap: u32,
    pub(super) rate: Option<Rate>,
}

#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub(super) struct Chance {
    pub(super) probability: u32,
    pub(super) rho: u32,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Table {
    /// Without a table.
    Uniform,
    Normal,
    Pareto,
    ParetoNormal,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Loss {
    Random(Chance),
    State {
        p13: u32,
        p31: u32,
        p32: u32,
        p23: u32,
        p14: u32,
    },
    /// `loss_bad` is 1 - h, `loss_good` 1 - k.
    Gilbert {
        p: u32,
        r: u32,
        loss_bad: u32,
        loss_good: u32,
    },
}

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) struct Rate {
    /// `tc` rounds to whole bytes.
    pub(super) bytes_per_s: u64,
    pub(super) overhead: i32,
    pub(super) cell_size: u32,
    pub(super) cell_overhead: i32,
}

/// Option names, in the order in which `tc` matches prefixes.
pub(super) const OPTIONS: [&str; 13] = [
    "limit",
    "latency",
    "delay",
    "loss",
    "drop",
    "ecn",
    "reorder",
    "corrupt",
    "gap",
    "duplicate",
    "distribution",
    "rate",
    "slot",
];

impl Arguments {
    /// Parse the arguments, with or without the command before them, or the output of `tc qdisc show` for a
    /// netem.
    pub(super) fn read(text: &str) -> Result<Self, LinkSettingsError> {
        Self::parse(text).map_err(|error| {
            LinkSettingsError::contradiction("netem", format!("column {}: {}", error.column, error.problem))
        })
    }

    fn parse(text: &str) -> Result<Self, ParseError> {
        if text.len() > MAX_TEXT_BYTES {
            return Err(ParseError::new(1, MAX_TEXT_BYTES, format!("longer than {MAX_TEXT_BYTES} bytes")));
        }
        let mut words = Words::new(text);
        let is_shown = words.skip_command()?;
        let mut arguments = Self::default();
        let mut has_loss = false;
        let mut ecn = None;
        while let Some(word) = words.next() {
            if is_shown && word.text == "seed" {
                // Seed of the kernel's generator, which a link does not have.
                words.next();
                continue;
            }
            let Some(option) = OPTIONS.into_iter().find(|option| option.starts_with(word.text)) else {
                return Err(word.unknown());
            };
            match option {
                "limit" => arguments.limit = words.integer("limit", 1, MAX_PACKETS)?,
                "latency" | "delay" => arguments.read_delay(&mut words)?,
                "loss" | "drop" => {
                    if std::mem::replace(&mut has_loss, true) {
                        return Err(word.error("a second loss; there may be one"));
                    }
                    arguments.loss = read_loss(&mut words)?;
                }
                // ECN does not apply to packets without ECN support, such as UDP: they are dropped in any
                // case.
                "ecn" => ecn = Some(word),
                "reorder" => arguments.reorder = words.chance("reorder")?,
                "corrupt" => arguments.corrupt = words.chance("corrupt")?,
                "gap" => arguments.gap = words.integer("gap", 0, u32::MAX)?,
                "duplicate" => arguments.duplicate = words.chance("duplicate")?,
                "distribution" => arguments.table = words.table()?,
                "rate" => arguments.rate = Some(words.rate()?),
                _ => return Err(word.error("slot is not reproduced; the `slots` of a link come near it")),
            }
        }
        if let Some(word) = ecn.filter(|_| !has_loss) {
            return Err(word.error("ecn needs a loss"));
        }
        arguments.check(words.end())
    }

    fn read_delay(&mut self, words: &mut Words<'_>) -> Result<(), ParseError> {
        self.latency_ns = words.time("delay")?;
        if words.number_is_next() {
            // The kernel caps it.
            self.jitter_ns = words.time("jitter")?.min(i64::from(i32::MAX));
            if words.number_is_next() {
                self.delay_rho = words.percent("delay correlation")?;
            }
        }
        Ok(())
    }

    /// Reject combinations that `tc` rejects.
    fn check(mut self, end: Word<'_>) -> Result<Self, ParseError> {
        if self.reorder.probability > 0 {
            if self.latency_ns == 0 {
                return Err(end.error("reorder needs a delay: what is reordered is sent without it"));
            }
            self.gap = self.gap.max(1);
        } else if self.gap > 0 {
            return Err(end.error("gap needs a probability of reorder"));
        }
        if self.table != Table::Uniform && (self.latency_ns == 0 || self.jitter_ns == 0) {
            return Err(end.error("distribution needs delay and jitter"));
        }
        Ok(self)
    }
}

impl Default for Arguments {
    fn default() -> Self {
        Self {
            limit: DEFAULT_LIMIT,
            latency_ns: 0,
            jitter_ns: 0,
            delay_rho: 0,
            table: Table::Uniform,
            loss: Loss::Random(Chance::default()),
            duplicate: Chance::default(),
            corrupt: Chance::default(),
            reorder: Chance::default(),
            gap: 0,
            rate: None,
        }
    }
}

fn read_loss(words: &mut Words<'_>) -> Result<Loss, ParseError> {
    match words.peek().map(|word| word.text) {
        Some("state") => {
            words.next();
            words.skip_label("p13");
            let p13 = words.percent("p13")?;
            let p31 = words.percent_or(u32::MAX - p13, "p31")?;
            let p32 = words.percent_or(0, "p32")?;
            let p23 = words.percent_or(u32::MAX, "p23")?;
            let p14 = words.percent_or(0, "p14")?;
            Ok(Loss::State { p13, p31, p32, p23, p14 })
        }
        Some("gemodel") => {
            words.next();
            words.skip_label("p");
            let p = words.percent("p")?;
            let r = words.percent_or(u32::MAX - p, "r")?;
            let loss_bad = words.percent_or(u32::MAX, "1-h")?;
            let loss_good = words.percent_or(0, "1-k")?;
            Ok(Loss::Gilbert { p, r, loss_bad, loss_good })
        }
        Some("random") => {
            words.next();
            words.chance("loss").map(Loss::Random)
        }
        _ => words.chance("loss").map(Loss::Random),
    }
}

#[derive(Clone, Copy, Debug)]
struct Word<'a> {
    column: usize,
    text: &'a str,
}

impl Word<'_> {
    fn error(&self, problem: impl Into<String>) -> ParseError {
        ParseError::new(1, self.column, problem)
    }

    fn unknown(&self) -> ParseError {
        if self.text == "seed" {
            return self.error("seed: the seed is that of the link");
        }
        self.error(format!("\"{}\" is no option; there are {}", self.text, OPTIONS.join(", ")))
    }

    fn split(&self) -> (Option<f64>, &str) {
        let is_number = |character: char| character.is_ascii_digit() || ".+-".contains(character);
        let length = self.text.find(|character| !is_number(character)).unwrap_or(self.text.len());
        let (number, unit) = self.text.split_at(length);
        (number.parse::<f64>().ok(), unit)
    }

    fn scaled(
        &self,
        name: &str,
        units: &[(&str, f64)],
        minimum: f64,
        maximum: f64,
    ) -> Result<f64, ParseError> {
        let (number, unit) = self.split();
        let factor = units.iter().find(|(name, _)| *name == unit.to_ascii_lowercase());
        if let (Some(number), Some((_, factor))) = (number, factor)
            && (minimum..=maximum).contains(&(number * factor))
        {
            return Ok(number * factor);
        }
        let names: Vec<&str> = units.iter().map(|(name, _)| *name).filter(|name| !name.is_empty()).collect();
        Err(self.error(format!(
            "{name} = \"{}\": must be a number from {minimum} to {maximum}, in {}",
            self.text,
            names.join(", ")
        )))
    }
}

#[derive(Clone, Debug)]
struct Words<'a> {
    text: &'a str,
    position: usize,
}

impl<'a> Words<'a> {
    fn new(text: &'a str) -> Self {
        Self { text, position: 0 }
    }

    fn peek(&self) -> Option<Word<'a>> {
        self.clone().next()
    }

    fn end(&self) -> Word<'a> {
        Word { column: self.text.trim_end().len() + 1, text: "" }
    }

    /// Skip any part of `tc qdisc add dev X root netem`; return true if the text is output of
    /// `tc qdisc show`.
    ///
    /// That output is `qdisc netem 8001: dev X root refcnt 2` and the options, one line per queue, with lines
    /// of statistics.
    ///
    /// Source: `tc_qdisc.c`, `print_qdisc`; `q_netem.c`, `netem_print_opt` (iproute2 6.18).
    fn skip_command(&mut self) -> Result<bool, ParseError> {
        let begins_with_command =
            self.peek().is_some_and(|word| ["sudo", "tc", "qdisc", "netem"].contains(&word.text));
        if !begins_with_command {
            return Ok(false);
        }
        while let Some(word) = self.next() {
            if word.text != "netem" {
                continue;
            }
            let is_shown = self.peek().is_some_and(|word| word.text.ends_with(':'));
            if is_shown {
                self.next();
                let line =
                    self.text[self.position..].find('\n').map_or(self.text.len(), |end| self.position + end);
                self.text = &self.text[..line];
                while let Some(place) = self.peek() {
                    match place.text {
                        "root" | "ingress" | "offloaded" => {}
                        "dev" | "parent" | "refcnt" => {
                            self.next();
                        }
                        _ => break,
                    }
                    self.next();
                }
            }
            return Ok(is_shown);
        }
        Err(self.end().error("a tc command without the word netem"))
    }

    /// Skip the name of the next number, which `tc qdisc show` prints.
    fn skip_label(&mut self, label: &str) {
        if self.peek().is_some_and(|word| word.text == label) {
            self.next();
        }
    }

    fn need(&mut self, name: &str) -> Result<Word<'a>, ParseError> {
        let end = self.end();
        self.next().ok_or_else(|| end.error(format!("{name} is missing")))
    }

    fn number_is_next(&self) -> bool {
        self.peek().is_some_and(|word| word.text.starts_with(|first: char| first.is_ascii_digit()))
    }

    fn signed_number_is_next(&self) -> bool {
        self.number_is_next() || self.peek().is_some_and(|word| word.text.starts_with('-'))
    }

    fn integer<T: FromStr + PartialOrd + Copy + std::fmt::Display>(
        &mut self,
        name: &str,
        minimum: T,
        maximum: T,
    ) -> Result<T, ParseError> {
        let word = self.need(name)?;
        match word.text.parse::<T>() {
            Ok(number) if (minimum..=maximum).contains(&number) => Ok(number),
            _ => Err(word.error(format!(
                "{name} = \"{}\": must be a whole number from {minimum} to {maximum}",
                word.text
            ))),
        }
    }

    /// Time in ns; a number without a unit is in us.
    fn time(&mut self, name: &str) -> Result<i64, ParseError> {
        const UNITS: [(&str, f64); 12] = [
            ("", 1e3),
            ("s", 1e9),
            ("sec", 1e9),
            ("secs", 1e9),
            ("ms", 1e6),
            ("msec", 1e6),
            ("msecs", 1e6),
            ("us", 1e3),
            ("usec", 1e3),
            ("usecs", 1e3),
            ("ns", 1.0),
            ("nsecs", 1.0),
        ];
        let time_ns = self.need(name)?.scaled(name, &UNITS, 0.0, MAX_DELAY_S * 1e9)?;
        #[expect(clippy::cast_possible_truncation, reason = "an hour at most")]
        let time_ns = time_ns.round() as i64;
        Ok(time_ns)
    }

    /// Percentage in units of 2^-32 - 1.
    fn percent(&mut self, name: &str) -> Result<u32, ParseError> {
        let percent = self.need(name)?.scaled(name, &[("", 1.0), ("%", 1.0)], 0.0, 100.0)?;
        #[expect(clippy::cast_possible_truncation, clippy::cast_sign_loss, reason = "0 to 2^32 - 1")]
        let share = (percent / 100.0 * f64::from(u32::MAX)).round_ties_even() as u32;
        Ok(share)
    }

    fn percent_or(&mut self, default: u32, name: &str) -> Result<u32, ParseError> {
        self.skip_label(name);
        if self.number_is_next() { self.percent(name) } else { Ok(default) }
    }

    fn chance(&mut self, name: &str) -> Result<Chance, ParseError> {
        let probability = self.percent(name)?;
        let rho = self.percent_or(0, &format!("{name} correlation"))?;
        Ok(Chance { probability, rho })
    }

    fn table(&mut self) -> Result<Table, ParseError> {
        let word = self.need("distribution")?;
        match word.text {
            "uniform" => Ok(Table::Uniform),
            "normal" => Ok(Table::Normal),
            "pareto" => Ok(Table::Pareto),
            "paretonormal" => Ok(Table::ParetoNormal),
            name => Err(word.error(format!(
                "distribution {name}: its table is a file of iproute2 that follows from no definition; read that file \
                 and give it as the table of `distribution`, beside delay_s and jitter_s instead of netem"
            ))),
        }
    }

    fn rate(&mut self) -> Result<Rate, ParseError> {
        let bits_per_s = self.need("rate")?.scaled("rate", &rate_units(), 8.0, 1e12)?;
        let mut rate = Rate {
            #[expect(clippy::cast_possible_truncation, clippy::cast_sign_loss, reason = "1 to 1e12")]
            bytes_per_s: (bits_per_s / 8.0) as u64,
            overhead: 0,
            cell_size: 0,
            cell_overhead: 0,
        };
        self.skip_label("packetoverhead");
        if self.signed_number_is_next() {
            rate.overhead = self.integer("packet overhead", -1000, 1000)?;
        }
        self.skip_label("cellsize");
        if self.number_is_next() {
            rate.cell_size = self.integer("cell size", 0, 65_535)?;
        }
        self.skip_label("celloverhead");
        if self.signed_number_is_next() {
            let word = self.peek();
            rate.cell_overhead = self.integer("cell overhead", -1000, 1000)?;
            if i64::from(rate.cell_size) + i64::from(rate.cell_overhead) < 1
                && let Some(word) = word
            {
                return Err(word.error("a cell with its overhead must have 1 byte at least"));
            }
        }
        Ok(rate)
    }
}

/// Units of rate; `bps` are bytes per second, as everywhere in `tc`.
fn rate_units() -> [(&'static str, f64); 19] {
    const KIBI: f64 = 1024.0;
    [
        ("", 1.0),
        ("bit", 1.0),
        ("kbit", 1e3),
        ("mbit", 1e6),
        ("gbit", 1e9),
        ("tbit", 1e12),
        ("kibit", KIBI),
        ("mibit", KIBI * KIBI),
        ("gibit", KIBI * KIBI * KIBI),
        ("tibit", KIBI * KIBI * KIBI * KIBI),
        ("bps", 8.0),
        ("kbps", 8e3),
        ("mbps", 8e6),
        ("gbps", 8e9),
        ("tbps", 8e12),
        ("kibps", 8.0 * KIBI),
        ("mibps", 8.0 * KIBI * KIBI),
        ("gibps", 8.0 * KIBI * KIBI * KIBI),
        ("tibps", 8.0 * KIBI * KIBI * KIBI * KIBI),
    ]
}

impl<'a> Iterator for Words<'a> {
    type Item = Word<'a>;

    fn next(&mut self) -> Option<Word<'a>> {
        let rest = &self.text[self.position..];
        let start = self.position + rest.len() - rest.trim_start().len();
        let rest = &self.text[start..];
        let length = rest.find(char::is_whitespace).unwrap_or(rest.len());
        self.position = start + length;
        (length > 0).then_some(Word { column: start + 1, text: &rest[..length] })
    }
}
