//! A driver's text on a fault: bounded, printable, and sent in pieces, one per frame.

use std::fmt;

/// Bytes of text per frame.
pub const PIECE: usize = 12;
/// Pieces of the longest text.
pub const PIECES: u8 = 20;
/// Longest text in bytes of UTF-8, without its final zero byte.
pub const MAX_FAULT_TEXT: usize = PIECE * PIECES as usize - 1;
/// Mark at the end of a truncated text.
const CUT: char = '\u{2026}';

/// A line of at most [`MAX_FAULT_TEXT`] bytes, without characters that move a cursor, or hide or reorder text.
#[derive(Clone, Copy, PartialEq, Eq)]
pub struct FaultText {
    bytes: [u8; MAX_FAULT_TEXT],
    length: u8,
}

struct Line {
    bytes: [u8; 255],
    length: usize,
}

impl fmt::Write for Line {
    fn write_str(&mut self, text: &str) -> fmt::Result {
        let Some(room) = self.bytes.get_mut(self.length..self.length + text.len()) else {
            return Err(fmt::Error);
        };
        room.copy_from_slice(text.as_bytes());
        self.length += text.len();
        Ok(())
    }
}

/// Return whether a character is printable, and neither reorders nor hides text.
fn is_printable(letter: char) -> bool {
    !letter.is_control()
        && !matches!(letter,
            '\u{AD}' | '\u{34F}' | '\u{600}'..='\u{605}' | '\u{61C}' | '\u{6DD}' | '\u{70F}' | '\u{890}' | '\u{891}'
            | '\u{8E2}' | '\u{115F}' | '\u{1160}' | '\u{110BD}' | '\u{110CD}' | '\u{13430}'..='\u{1343F}'
            | '\u{1BCA0}'..='\u{1BCA3}' | '\u{1D173}'..='\u{1D17A}'
            | '\u{17B4}' | '\u{17B5}' | '\u{180B}'..='\u{180F}' | '\u{200B}'..='\u{200F}' | '\u{2028}'..='\u{202E}'
            | '\u{2060}'..='\u{206F}' | '\u{3164}' | '\u{E000}'..='\u{F8FF}' | '\u{FE00}'..='\u{FE0F}' | '\u{FEFF}'
            | '\u{FFA0}' | '\u{FFF0}'..='\u{FFFB}' | '\u{E0000}'..='\u{10FFFF}')
}

impl FaultText {
    /// No text.
    pub const EMPTY: Self = Self { bytes: [0; MAX_FAULT_TEXT], length: 0 };

    /// Put `text` on one line: white space becomes blanks, unprintable characters U+FFFD; a long text is truncated.
    pub fn new(text: &str) -> Self {
        let mut built = Self::EMPTY;
        // Length up to which the mark still fits.
        let mut fits = 0;
        let letters = text
            .split_whitespace()
            .enumerate()
            .flat_map(|(index, word)| (index > 0).then_some(' ').into_iter().chain(word.chars()));
        for letter in letters {
            let letter = if is_printable(letter) { letter } else { char::REPLACEMENT_CHARACTER };
            if !built.push(letter) {
                built.length = fits;
                built.bytes[usize::from(fits)..].fill(0);
                built.push(CUT);
                break;
            }
            if usize::from(built.length) + CUT.len_utf8() <= MAX_FAULT_TEXT {
                fits = built.length;
            }
        }
        built
    }

    /// As [`new`](Self::new), for formatted text, without allocation. Drops the first piece written beyond 255 bytes,
    /// and all after it.
    pub fn of(written: &impl fmt::Display) -> Self {
        let mut line = Line { bytes: [0; 255], length: 0 };
        // Keeps the pieces that fit.
        let _ = fmt::Write::write_fmt(&mut line, format_args!("{written}"));
        Self::new(std::str::from_utf8(&line.bytes[..line.length]).unwrap_or_default())
    }

    fn push(&mut self, letter: char) -> bool {
        let (start, mut bytes) = (usize::from(self.length), [0; 4]);
        let letter = letter.encode_utf8(&mut bytes).as_bytes();
        let Some(room) = self.bytes.get_mut(start..start + letter.len()) else { return false };
        room.copy_from_slice(letter);
        #[allow(clippy::cast_possible_truncation)] // at most 239
        {
            self.length = (start + letter.len()) as u8;
        }
        true
    }

    /// The text.
    pub fn as_str(&self) -> &str {
        // Composed of whole characters.
        std::str::from_utf8(&self.bytes[..usize::from(self.length)]).unwrap_or_default()
    }

    /// Return whether there is no text.
    pub const fn is_empty(&self) -> bool {
        self.length == 0
    }

    /// Number of pieces; the last one contains the final zero byte.
    #[allow(clippy::cast_possible_truncation)] // 12
    const fn pieces(&self) -> u8 {
        self.length / PIECE as u8 + 1
    }
}

impl Default for FaultText {
    fn default() -> Self {
        Self::EMPTY
    }
}

impl fmt::Debug for FaultText {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        fmt::Debug::fmt(self.as_str(), f)
    }
}

/// Piece of a text in one frame.
///
/// Aligned to copy whole words. A copy of 14 bytes would be two overlapping words, for which the next copy waits
/// (store forwarding fails).
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
#[repr(align(8))]
pub struct TextPiece {
    /// Number of the sender's text, 1 to 255; 0 without text.
    pub number: u8,
    /// Index of the piece, from 0.
    pub index: u8,
    /// Its bytes; zeros after the end of the text.
    pub bytes: [u8; PIECE],
}

impl TextPiece {
    /// Return whether the encoding is canonical: zeros without text and after the end.
    #[inline]
    pub fn is_canonical(&self) -> bool {
        if self.number == 0 { *self == Self::default() } else { self.is_canonical_piece() }
    }

    fn is_canonical_piece(&self) -> bool {
        let end = self.bytes.iter().position(|byte| *byte == 0);
        let ended = end.is_none_or(|end| self.bytes[end..].iter().all(|byte| *byte == 0));
        ended && self.index < PIECES && (end.is_some() || self.index + 1 < PIECES)
    }
}

/// Text of a side, split into frames.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct SentText {
    text: FaultText,
    number: u8,
    next: u8,
}

impl SentText {
    /// Set the text; no effect if it is the same.
    pub fn set(&mut self, text: &FaultText) {
        if self.text != *text {
            // Never 0, which means no text.
            let number = self.number.checked_add(1).unwrap_or(1);
            *self = Self { text: *text, number, next: 0 };
        }
    }

    /// The text.
    pub fn text(&self) -> &FaultText {
        &self.text
    }

    /// Return the piece of the next frame, in order.
    pub fn next_piece(&mut self) -> TextPiece {
        if self.text.is_empty() {
            return TextPiece::default();
        }
        let index = self.next;
        self.next = (index + 1) % self.text.pieces();
        let mut bytes = [0; PIECE];
        let rest = &self.text.bytes[usize::from(index) * PIECE..];
        let length = rest.len().min(PIECE);
        bytes[..length].copy_from_slice(&rest[..length]);
        TextPiece { number: self.number, index, bytes }
    }
}

/// Peer's text, reassembled from pieces in any order, with repeats.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct ReceivedText {
    number: u8,
    seen: u32,
    bytes: [u8; MAX_FAULT_TEXT + 1],
    complete: FaultText,
}

impl Default for ReceivedText {
    fn default() -> Self {
        Self { number: 0, seen: 0, bytes: [0; MAX_FAULT_TEXT + 1], complete: FaultText::EMPTY }
    }
}

impl ReceivedText {
    /// Take a piece; pieces of different texts do not mix.
    #[inline]
    pub fn take(&mut self, piece: &TextPiece) {
        // Nearly all frames have none.
        if piece.number != 0 || self.number != 0 {
            self.take_piece(piece);
        }
    }

    fn take_piece(&mut self, piece: &TextPiece) {
        if piece.number != self.number {
            *self = Self { number: piece.number, ..Self::default() };
        }
        if piece.number == 0 || piece.index >= PIECES || self.seen >> piece.index & 1 != 0 {
            return;
        }
        let start = usize::from(piece.index) * PIECE;
        self.bytes[start..start + PIECE].copy_from_slice(&piece.bytes);
        self.seen |= 1 << piece.index;
        // Complete from the first piece to the first zero.
        let reached = usize::try_from(self.seen.trailing_ones()).unwrap_or(0) * PIECE;
        if let Some(end) = self.bytes[..reached].iter().position(|byte| *byte == 0) {
            // Untrusted: invalid UTF-8 ends the text, and the rest is made printable.
            let text = match std::str::from_utf8(&self.bytes[..end]) {
                Ok(text) => text,
                Err(error) => std::str::from_utf8(&self.bytes[..error.valid_up_to()]).unwrap_or_default(),
            };
            self.complete = FaultText::new(text);
        }
    }

    /// The text, once all of it has arrived.
    pub fn text(&self) -> &FaultText {
        &self.complete
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    fn carried(text: &FaultText, mut arrives: impl FnMut(usize) -> bool) -> FaultText {
        let (mut spoken, mut heard) = (SentText::default(), ReceivedText::default());
        spoken.set(text);
        for n in 0..2000 {
            let piece = spoken.next_piece();
            assert!(piece.is_canonical(), "{piece:?}");
            if arrives(n) {
                heard.take(&piece);
            }
        }
        *heard.text()
    }

    #[test]
    fn a_text_is_one_line_of_printable_characters() {
        for (text, shown) in [
            ("the bus is down", "the bus is down"),
            ("  two\r\n\tlines \n", "two lines"),
            ("\x1b[2Jgone\x07", "\u{FFFD}[2Jgone\u{FFFD}"),
            ("\u{9b}31m", "\u{FFFD}31m"),
            ("a\u{202E}b\u{200B}c\u{FEFF}d\u{E0041}", "a\u{FFFD}b\u{FFFD}c\u{FFFD}d\u{FFFD}"),
            ("K\u{F6}nig \u{4E2D}\u{1F916}", "K\u{F6}nig \u{4E2D}\u{1F916}"),
            ("", ""),
        ] {
            assert_eq!(FaultText::new(text).as_str(), shown);
        }
    }

    #[test]
    fn long_text_is_truncated_between_characters() {
        let whole = "x".repeat(MAX_FAULT_TEXT);
        assert_eq!(FaultText::new(&whole).as_str(), whole);
        let cut = FaultText::new(&"x".repeat(MAX_FAULT_TEXT + 1));
        assert_eq!(cut.as_str(), format!("{}\u{2026}", "x".repeat(MAX_FAULT_TEXT - 3)));
        for letter in ["\u{E9}", "\u{4E2D}", "\u{1F916}"] {
            for shift in 0..4 {
                let text = format!("{}{}", "x".repeat(shift), letter.repeat(200));
                let cut = FaultText::new(&text);
                assert!(cut.as_str().ends_with('\u{2026}') && cut.as_str().len() > MAX_FAULT_TEXT - 8);
                assert_eq!(carried(&cut, |_| true), cut);
            }
        }
    }

    #[test]
    fn pieces_of_two_texts_do_not_mix() {
        let (mut spoken, mut heard) = (SentText::default(), ReceivedText::default());
        spoken.set(&FaultText::new("a first text, of more than one piece"));
        heard.take(&spoken.next_piece());
        heard.take(&spoken.next_piece());
        spoken.set(&FaultText::new("another, of more than one piece as well"));
        while heard.text().is_empty() {
            heard.take(&spoken.next_piece());
        }
        assert_eq!(heard.text().as_str(), "another, of more than one piece as well");
        spoken.set(&FaultText::EMPTY);
        heard.take(&spoken.next_piece());
        assert!(heard.text().is_empty());
    }

    /// From any sender, the text is one printable line.
    #[test]
    fn text_of_hostile_peer_is_one_line() {
        let mut heard = ReceivedText::default();
        let mut bytes = [0; PIECE];
        bytes[..7].copy_from_slice(b"a\x1b[2J\nb");
        heard.take(&TextPiece { number: 9, index: 0, bytes });
        assert_eq!(heard.text().as_str(), "a\u{FFFD}[2J b");
        bytes[..3].copy_from_slice(b"ok\xFF");
        heard.take(&TextPiece { number: 10, index: 0, bytes });
        assert_eq!(heard.text().as_str(), "ok");
        heard.take(&TextPiece { number: 11, index: 255, bytes });
        assert!(heard.text().is_empty());
    }

    proptest! {
        /// Any text arrives unchanged once each piece has arrived.
        #[test]
        fn a_text_arrives_over_losses(text in "\\PC{0,150}", seed in any::<u64>()) {
            let text = FaultText::new(&text);
            let mut state = seed | 1;
            let arrived = carried(&text, |_| {
                state ^= state << 13;
                state ^= state >> 7;
                state ^= state << 17;
                state % 3 == 0
            });
            prop_assert_eq!(arrived, text);
        }

        #[test]
        fn noise_of_any_bytes_makes_a_line(pieces in prop::collection::vec(
            (any::<u8>(), any::<u8>(), any::<[u8; PIECE]>()), 0..200)) {
            let mut heard = ReceivedText::default();
            for (number, index, bytes) in pieces {
                heard.take(&TextPiece { number: number % 3, index: index % 24, bytes });
                prop_assert!(heard.text().as_str().chars().all(is_printable));
            }
        }
    }
}
