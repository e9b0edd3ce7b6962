//! What the system knows of this process, under the names that Prometheus' own clients use.

use std::fs;

use rustix::process::{Resource, getrlimit};

use super::{names, write_by_hand};

/// Appends the `process_*` metrics. What the system does not tell is left out (outside of Linux, all of it).
pub fn write(text: &mut String) {
    let stat = fs::read_to_string("/proc/self/stat").ok().and_then(|line| Stat::of(&line));
    let boot = fs::read_to_string("/proc/stat").ok().and_then(|text| boot_s(&text));
    let tick_s = 1.0 / rustix::param::clock_ticks_per_second() as f64;
    let mut tell = |name, value: Option<f64>| {
        if let Some(value) = value {
            write_by_hand(text, name, &[(String::new(), value)]);
        }
    };
    tell(names::PROCESS_CPU, stat.map(|stat| stat.cpu_ticks as f64 * tick_s));
    tell(
        names::PROCESS_RESIDENT,
        stat.map(|stat| (stat.resident_pages * rustix::param::page_size() as u64) as f64),
    );
    tell(names::PROCESS_VIRTUAL, stat.map(|stat| stat.virtual_bytes as f64));
    // The directory that is read counts as one of them.
    tell(names::PROCESS_OPEN_FDS, fs::read_dir("/proc/self/fd").ok().map(|open| open.count() as f64));
    tell(names::PROCESS_MAX_FDS, stat.and(getrlimit(Resource::Nofile).current).map(|most| most as f64));
    let start = stat.zip(boot).map(|(stat, boot)| boot as f64 + stat.start_ticks as f64 * tick_s);
    tell(names::PROCESS_START, start);
}

/// Figures of `/proc/self/stat` (proc_pid_stat(5)).
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
struct Stat {
    cpu_ticks: u64,
    /// Since the machine started.
    start_ticks: u64,
    virtual_bytes: u64,
    resident_pages: u64,
}

impl Stat {
    fn of(line: &str) -> Option<Self> {
        // The second field, the name in brackets, may hold blanks and brackets; the rest begins with the third.
        let rest: Vec<&str> = line.rsplit_once(')')?.1.split_whitespace().collect();
        let field = |number: usize| rest.get(number - 3)?.parse::<u64>().ok();
        Some(Self {
            cpu_ticks: field(14)? + field(15)?,
            start_ticks: field(22)?,
            virtual_bytes: field(23)?,
            resident_pages: field(24)?,
        })
    }
}

/// When the machine started, seconds since 1970.
fn boot_s(stat: &str) -> Option<u64> {
    stat.lines().find_map(|line| line.strip_prefix("btime "))?.trim().parse().ok()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_systems_line_is_read_whatever_the_process_is_called() {
        let line = "7 (a) b (c)) S 1 7 7 0 -1 4194560 100 0 0 0 250 50 9 9 20 0 4 0 12345 1048576 256 18446744073709551615";
        let stat = Stat { cpu_ticks: 300, start_ticks: 12345, virtual_bytes: 1_048_576, resident_pages: 256 };
        assert_eq!(Stat::of(line), Some(stat));
        assert_eq!(Stat::of("7 (a) S 1"), None);
        assert_eq!(boot_s("cpu 1 2\nbtime 1700000000\nprocesses 5\n"), Some(1_700_000_000));
    }

    #[cfg(target_os = "linux")]
    #[test]
    fn this_process_has_used_some_time_and_memory_and_began_lately() {
        let mut text = String::new();
        write(&mut text);
        let value = |name: &str| -> f64 {
            let line = text.lines().find(|line| line.split(' ').next() == Some(name));
            line.and_then(|line| line.split(' ').nth(1)?.parse().ok())
                .unwrap_or_else(|| panic!("{name}: {text}"))
        };
        assert!(value(names::PROCESS_CPU) >= 0.0);
        let resident = value(names::PROCESS_RESIDENT);
        assert!(resident > 1e6 && resident < value(names::PROCESS_VIRTUAL), "{text}");
        assert!(value(names::PROCESS_OPEN_FDS) >= 3.0 && value(names::PROCESS_MAX_FDS) > 3.0, "{text}");
        let now = jiff::Timestamp::now().as_second() as f64;
        let age = now - value(names::PROCESS_START);
        assert!((-2.0..86_400.0).contains(&age), "{age} s old: {text}");
    }
}
