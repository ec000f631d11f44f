//! Headers to write: cards of 80 characters in blocks of 2880 bytes, by the FITS standard 4.0, section 4.

/// Bytes of a block: headers and data each fill whole ones.
pub const BLOCK: usize = 2880;
const CARD: usize = 80;
// Most characters of a text between its quotes.
const LONGEST_TEXT: usize = 68;
// Fewest characters of a text between its quotes.
const SHORTEST_TEXT: usize = 8;
// Significant digits that distinguish any two numbers.
const DIGITS: i32 = 17;

#[derive(Debug, Clone, PartialEq)]
pub enum Value {
    Int(i64),
    Real(f64),
    /// Text of printable ASCII characters. A long one continues on CONTINUE cards.
    Text(String),
}

#[derive(Debug, Default)]
pub struct Header(String);

impl Header {
    /// The header of a file: `bits` per pixel, negative for floats, and the `sides`, x first.
    pub fn primary(bits: i64, sides: &[usize]) -> Self {
        let mut header = Header::default();
        header.logical("SIMPLE", "file does conform to FITS standard");
        header.count("BITPIX", bits, "number of bits per data pixel");
        header.count("NAXIS", sides.len(), "number of data axes");
        for (axis, side) in sides.iter().enumerate() {
            let axis = axis + 1;
            let comment = format!("length of data axis {axis}");
            header.count(&format!("NAXIS{axis}"), side, &comment);
        }
        header.logical("EXTEND", "FITS dataset may contain extensions");
        for line in [
            "  FITS (Flexible Image Transport System) format is defined in 'Astronomy",
            "  and Astrophysics', volume 376, page 359; bibcode: 2001A&A...376..359H",
        ] {
            header.card(format!("COMMENT {line}"));
        }
        header
    }

    pub fn add(&mut self, key: &str, value: &Value) -> Result<(), String> {
        let allowed = |c: char| matches!(c, 'A'..='Z' | '0'..='9' | '-' | '_');
        if !(1..=8).contains(&key.len()) || !key.chars().all(allowed) {
            return Err(format!(
                "`{key}` is no key of a FITS header: one to eight of A-Z, 0-9, - and _"
            ));
        }
        match value {
            Value::Int(value) => self.fixed(key, &value.to_string(), ""),
            Value::Real(value) if value.is_finite() => self.fixed(key, &real(*value), ""),
            Value::Real(value) => {
                return Err(format!(
                    "the header key {key} cannot have the value {value}"
                ));
            }
            Value::Text(value) => self.text(key, value, "")?,
        }
        Ok(())
    }

    pub fn text(&mut self, key: &str, value: &str, comment: &str) -> Result<(), String> {
        if let Some(other) = value.chars().find(|c| !matches!(c, ' '..='~')) {
            return Err(format!(
                "the header key {key} has the character {other:?}; FITS allows printable ASCII"
            ));
        }
        let pieces = pieces(value);
        let last = pieces.len() - 1;
        for (k, piece) in pieces.iter().enumerate() {
            let start = match k {
                0 => format!("{key:<8}= "),
                _ => "CONTINUE  ".to_owned(),
            };
            let quoted = match k {
                _ if k < last => format!("'{piece}&'"),
                _ => format!("'{piece:<SHORTEST_TEXT$}'"),
            };
            let comment = if comment.is_empty() {
                String::new()
            } else {
                format!(" / {comment}")
            };
            self.card(format!("{start}{quoted:<20}{comment}"));
        }
        Ok(())
    }

    pub fn count(&mut self, key: &str, value: impl ToString, comment: &str) {
        self.fixed(key, &value.to_string(), comment);
    }

    /// The blocks of the finished header.
    pub fn blocks(mut self) -> Vec<u8> {
        self.card("END".into());
        let mut bytes = self.0.into_bytes();
        bytes.resize(bytes.len().next_multiple_of(BLOCK), b' ');
        bytes
    }

    fn logical(&mut self, key: &str, comment: &str) {
        self.fixed(key, "T", comment);
    }

    // A value in fixed format: it ends in column 30 if it has room.
    fn fixed(&mut self, key: &str, value: &str, comment: &str) {
        let comment = if comment.is_empty() {
            String::new()
        } else {
            format!(" / {comment}")
        };
        self.card(format!("{key:<8}= {value:>20}{comment}"));
    }

    fn card(&mut self, text: String) {
        self.0.push_str(&format!("{text:<CARD$.CARD$}"));
    }
}

// A text with its quotes doubled, in pieces that each fit on a card. All but the last leave room for `&`.
fn pieces(text: &str) -> Vec<String> {
    let mut pieces = vec![String::new()];
    let mut letters = text.chars().peekable();
    while let Some(letter) = letters.next() {
        let width = 1 + usize::from(letter == '\'');
        let room = LONGEST_TEXT - usize::from(letters.peek().is_some());
        let mut piece = pieces.pop().unwrap_or_default();
        if piece.len() + width > room {
            pieces.push(piece);
            piece = String::new();
        }
        for _ in 0..width {
            piece.push(letter);
        }
        pieces.push(piece);
    }
    pieces
}

// A finite number with `DIGITS` digits, without zeros at the end: `0.5`, `3.` or `1.0E-12`.
fn real(value: f64) -> String {
    let scientific = format!("{:.*e}", DIGITS as usize - 1, value);
    let (mantissa, exponent) = scientific.split_once('e').unwrap_or((&scientific, "0"));
    let exponent: i32 = exponent.parse().unwrap_or(0);
    let trimmed = |number: &str| number.trim_end_matches('0').to_owned();
    if (-4..DIGITS).contains(&exponent) {
        let decimals = (DIGITS - 1 - exponent) as usize;
        let number = format!("{value:.decimals$}");
        return if number.contains('.') {
            trimmed(&number)
        } else {
            number + "."
        };
    }
    let mut mantissa = trimmed(mantissa);
    if mantissa.ends_with('.') {
        mantissa.push('0');
    }
    let sign = if exponent < 0 { '-' } else { '+' };
    format!("{mantissa}E{sign}{:02}", exponent.abs())
}

#[cfg(test)]
mod tests {
    use super::*;

    fn cards(header: Header) -> Vec<String> {
        let blocks = header.blocks();
        assert_eq!(blocks.len() % BLOCK, 0);
        let lines = blocks
            .chunks(CARD)
            .map(|card| String::from_utf8(card.to_vec()).unwrap());
        lines
            .map(|line| line.trim_end().to_owned())
            .filter(|line| !line.is_empty())
            .collect()
    }

    #[test]
    fn numbers_have_all_their_digits() {
        // C prints these strings for "%.17G", without the decimal point at the end.
        let known = [
            (0.0, "0."),
            (-0.0, "-0."),
            (1.0, "1."),
            (-2.5, "-2.5"),
            (0.1, "0.10000000000000001"),
            (1e-4, "0.0001"),
            (1e-5, "1.0000000000000001E-05"),
            (1e16, "10000000000000000."),
            (1e17, "1.0E+17"),
            (2.5e-300, "2.5E-300"),
            (123_456_789.125, "123456789.125"),
            (f64::MAX, "1.7976931348623157E+308"),
        ];
        for (value, text) in known {
            assert_eq!(real(value), text, "{value:e}");
            assert_eq!(text.parse::<f64>().unwrap().to_bits(), f64::to_bits(value));
        }
    }

    #[test]
    fn texts_continue_and_keep_their_quotes() {
        for length in [0, 1, 7, 8, 67, 68, 69, 134, 135, 136, 300] {
            for quote in ['x', '\''] {
                let text: String = (0..length)
                    .map(|k| if k % 3 == 1 { quote } else { 'a' })
                    .collect();
                let mut header = Header::default();
                header.add("KEY", &Value::Text(text.clone())).unwrap();
                let cards = cards(header);
                let mut read = String::new();
                for card in &cards[..cards.len() - 1] {
                    let inner = card[10..]
                        .strip_prefix('\'')
                        .unwrap()
                        .strip_suffix('\'')
                        .unwrap();
                    assert!(inner.len() <= LONGEST_TEXT && inner.len() >= SHORTEST_TEXT);
                    read.truncate(read.trim_end_matches('&').len());
                    read.push_str(&inner.replace("''", "'"));
                }
                assert_eq!(read.trim_end(), text);
            }
        }
    }

    #[test]
    fn what_the_standard_forbids_is_refused() {
        let mut header = Header::default();
        for key in ["", "lower", "TOO_LONG_", "A B", "Ä"] {
            assert!(header.add(key, &Value::Int(1)).is_err(), "{key}");
        }
        for value in [f64::NAN, f64::INFINITY] {
            assert!(header.add("KEY", &Value::Real(value)).is_err());
        }
        assert!(
            header
                .add("KEY", &Value::Text("two\nlines".into()))
                .is_err()
        );
        assert_eq!(cards(header), ["END"]);
    }
}
