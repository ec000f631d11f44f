//! Deadlines of a challenge, and the clock of arrivals.

use std::fmt;
use std::str::FromStr;

use jiff::civil::Date;
use jiff::tz::TimeZone;
use jiff::{Timestamp, ZonedDateTime};
use serde::{Deserialize, Deserializer, Serialize, Serializer};

/// A deadline: a whole day in UTC, or a moment with its zone.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Deadline {
    text: String,
    /// First second: entries of this second are not before it.
    pub first: Timestamp,
    /// Last second: entries of this second are not after it.
    pub last: Timestamp,
}

impl fmt::Display for Deadline {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self.first == self.last {
            // Participants live in other zones.
            true if !self.text.ends_with('Z') => write!(f, "{}, {}", self.text, self.first),
            true => f.write_str(&self.text),
            false => write!(f, "{} (UTC)", self.text),
        }
    }
}

impl FromStr for Deadline {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        let wrong = |_| {
            format!(
                "not a day or a moment (found `{text}`, expected such as 2026-12-01, 2026-12-01T18:00+01:00 or 2026-12-01T18:00[Europe/Berlin])"
            )
        };
        let second = |moment: Timestamp| Timestamp::from_second(moment.as_second()).map_err(wrong);
        // Jiff reads the date of a longer text as well.
        if let (10, Ok(day)) = (text.len(), text.parse::<Date>()) {
            let utc = |hour, minute, second| {
                let time = day.at(hour, minute, second, 0);
                TimeZone::UTC.to_timestamp(time).map_err(wrong)
            };
            return Ok(Deadline {
                text: text.into(),
                first: utc(0, 0, 0)?,
                last: utc(23, 59, 59)?,
            });
        }
        // The offset comes first, so that the description of a challenge is read where no zone files are.
        let (text, moment) = match text.parse::<Timestamp>() {
            Ok(moment) => (text.to_owned(), second(moment)?),
            Err(_) => {
                let moment: ZonedDateTime = text.parse().map_err(wrong)?;
                (moment.to_string(), second(moment.timestamp())?)
            }
        };
        Ok(Deadline {
            text,
            first: moment,
            last: moment,
        })
    }
}

impl Serialize for Deadline {
    fn serialize<S: Serializer>(&self, serializer: S) -> Result<S::Ok, S::Error> {
        serializer.serialize_str(&self.text)
    }
}

impl<'de> Deserialize<'de> for Deadline {
    fn deserialize<D: Deserializer<'de>>(deserializer: D) -> Result<Self, D::Error> {
        let text = String::deserialize(deserializer)?;
        text.parse().map_err(serde::de::Error::custom)
    }
}

pub fn now() -> Timestamp {
    let now = Timestamp::now();
    Timestamp::from_second(now.as_second()).unwrap_or(now)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn parse(text: &str) -> Result<Deadline, String> {
        text.parse()
    }

    #[test]
    fn a_day_lasts_until_its_last_second_in_utc() {
        let day = parse("2026-12-31").unwrap();
        assert_eq!(day.first.to_string(), "2026-12-31T00:00:00Z");
        assert_eq!(day.last.to_string(), "2026-12-31T23:59:59Z");
        assert_eq!(day.to_string(), "2026-12-31 (UTC)");
    }

    #[test]
    fn a_moment_has_the_offset_of_its_zone() {
        // Berlin is an hour ahead of UTC in winter, and two hours in summer.
        for (text, utc, printed) in [
            (
                "2026-12-01T18:00Z",
                "2026-12-01T18:00:00Z",
                "2026-12-01T18:00Z",
            ),
            (
                "2026-12-01T18:00:00+01:00",
                "2026-12-01T17:00:00Z",
                "2026-12-01T18:00:00+01:00, 2026-12-01T17:00:00Z",
            ),
            (
                "2026-12-01T18:00[Europe/Berlin]",
                "2026-12-01T17:00:00Z",
                "2026-12-01T18:00:00+01:00[Europe/Berlin], 2026-12-01T17:00:00Z",
            ),
            (
                "2026-07-01T18:00[Europe/Berlin]",
                "2026-07-01T16:00:00Z",
                "2026-07-01T18:00:00+02:00[Europe/Berlin], 2026-07-01T16:00:00Z",
            ),
        ] {
            let moment = parse(text).unwrap();
            assert_eq!(moment.first.to_string(), utc, "{text}");
            assert_eq!(moment.first, moment.last);
            assert_eq!(moment.to_string(), printed);
            assert_eq!(parse(&moment.text).as_ref(), Ok(&moment));
        }
    }

    #[test]
    fn impossible_and_ambiguous_deadlines_are_refused() {
        assert!(parse("2024-02-29").is_ok());
        for wrong in [
            "2026-02-29",
            "2026-13-01",
            "2026-1-1",
            "soon",
            "2026-12-01T18:00",
            "2026-12-01 18:00",
            "2026-12-01T18:00[Europe/Atlantis]",
            "9999-12-31",
            "12026-12-01",
        ] {
            assert!(parse(wrong).is_err(), "{wrong}");
        }
    }
}
