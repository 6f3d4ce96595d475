// SPDX-License-Identifier: MIT OR Apache-2.0
//! Dates in output.

/// A time in the form `2026-11-23 10:00:00`, in UTC.
pub fn date(unix_ns: i64) -> String {
    let seconds = unix_ns.div_euclid(1_000_000_000);
    let (days, second) = (seconds.div_euclid(86_400), seconds.rem_euclid(86_400));
    let (year, month, day) = civil(days);
    let (hour, minute, second) = (second / 3600, second / 60 % 60, second % 60);
    format!("{year:04}-{month:02}-{day:02} {hour:02}:{minute:02}:{second:02}")
}

/// The date of a number of days after 1970-01-01, by the Gregorian calendar. A year that begins in March has its leap day at its end.
fn civil(days: i64) -> (i64, i64, i64) {
    let days = days + 719_468;
    let (era, day_of_era) = (days.div_euclid(146_097), days.rem_euclid(146_097));
    let year = (day_of_era - day_of_era / 1460 + day_of_era / 36_524 - day_of_era / 146_096) / 365;
    let day_of_year = day_of_era - (365 * year + year / 4 - year / 100);
    let month = (5 * day_of_year + 2) / 153;
    let day = day_of_year - (153 * month + 2) / 5 + 1;
    let is_next = month >= 10;
    (year + era * 400 + i64::from(is_next), if is_next { month - 9 } else { month + 3 }, day)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn days_are_counted_by_the_gregorian_calendar() {
        assert_eq!([civil(0), civil(11_016), civil(20_780)], [(1970, 1, 1), (2000, 2, 29), (2026, 11, 23)]);
        assert_eq!([civil(-1), civil(11_017)], [(1969, 12, 31), (2000, 3, 1)]);
        assert_eq!(date(-1), "1969-12-31 23:59:59");
    }
}
