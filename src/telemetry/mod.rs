//! Logs and metrics.
//!
//! A log line is readable alone and carries dotted fields with the unit in the name. Sample data and
//! request bodies are never logged. Metrics are Prometheus', in seconds and bytes.

pub mod names;
pub mod process;

use std::fmt::{self, Write};
use std::sync::OnceLock;

use metrics::{Unit, describe_counter, describe_gauge, describe_histogram};
use metrics_exporter_prometheus::{Matcher, PrometheusBuilder, PrometheusHandle};
use names::Kind;
use tracing_subscriber::field::MakeExt;
use tracing_subscriber::filter::{ParseError, Targets};
use tracing_subscriber::fmt::FormatFields;
use tracing_subscriber::fmt::format::{Writer, debug_fn};
use tracing_subscriber::layer::SubscriberExt;
use tracing_subscriber::util::SubscriberInitExt;

/// Format of log lines.
#[derive(Debug, Clone, Copy, PartialEq, Eq, clap::ValueEnum)]
pub enum LogFormat {
    /// One readable line per event.
    Text,
    /// One JSON object per event.
    Json,
}

/// A log filter that cannot be understood.
#[derive(Debug, thiserror::Error)]
#[error("log filter {filter:?}: {reason}")]
pub struct LogFilterError {
    filter: String,
    reason: String,
}

/// Starts logging to standard error. Later calls in one process leave the first in place.
///
/// # Errors
/// A filter that is not a list of levels and directives.
pub fn init_logging(filter: &str, format: LogFormat) -> Result<(), LogFilterError> {
    let filter: Targets = filter.parse().map_err(|error: ParseError| LogFilterError {
        filter: filter.to_owned(),
        reason: error.to_string(),
    })?;
    let registry = tracing_subscriber::registry().with(filter);
    let lines = tracing_subscriber::fmt::layer().with_writer(std::io::stderr);
    // Only a second call in one process can fail; the logging of the first call then stays.
    let _ = match format {
        LogFormat::Text => registry.with(lines.with_ansi(false).fmt_fields(text_fields())).try_init(),
        LogFormat::Json => registry.with(lines.json().flatten_event(true)).try_init(),
    };
    Ok(())
}

/// Writes fields on one line. Names that clients chose may hold line ends and codes that move a
/// terminal's cursor. (JSON needs no such escaping.)
fn text_fields() -> impl for<'writer> FormatFields<'writer> + Send + Sync + 'static {
    let field = |writer: &mut Writer<'_>, field: &tracing::field::Field, value: &dyn fmt::Debug| {
        let value = on_one_line(&format!("{value:?}"));
        match field.name() {
            "message" => writer.write_str(&value),
            name => write!(writer, "{name}={value}"),
        }
    };
    debug_fn(field).delimited(" ")
}

/// The text with its control characters escaped, including those that change the direction of text.
fn on_one_line(text: &str) -> String {
    let mut line = String::with_capacity(text.len());
    for c in text.chars() {
        match c {
            '\u{2028}' | '\u{2029}' | '\u{202a}'..='\u{202e}' | '\u{2066}'..='\u{2069}' => {
                line.extend(c.escape_unicode());
            }
            c if c.is_control() => line.extend(c.escape_default()),
            c => line.push(c),
        }
    }
    line
}

/// The process' metrics; installed by the first call.
///
/// # Panics
/// When other code of the same process has installed a recorder of its own, which is a defect.
pub fn metrics_handle() -> PrometheusHandle {
    static HANDLE: OnceLock<PrometheusHandle> = OnceLock::new();
    HANDLE
        .get_or_init(|| {
            let handle = PrometheusBuilder::new()
                .set_buckets(&REQUEST_BUCKETS)
                .and_then(|b| {
                    b.set_buckets_for_metric(Matcher::Full(names::FIT_SECONDS.into()), &FIT_BUCKETS)
                })
                .expect("the bucket lists are not empty")
                .install_recorder()
                .expect("nobody else installs a metrics recorder");
            describe();
            count_panics();
            handle
        })
        .clone()
}

/// Buckets from a health check to a prediction of an hour, seconds.
const REQUEST_BUCKETS: [f64; 13] =
    [0.001, 0.0025, 0.005, 0.01, 0.025, 0.05, 0.1, 0.25, 0.5, 1.0, 2.5, 10.0, 60.0];
/// Buckets from an FRF to an LSTM fit of a night, seconds.
const FIT_BUCKETS: [f64; 9] = [0.1, 1.0, 5.0, 15.0, 60.0, 300.0, 900.0, 3600.0, 14400.0];

/// Describes each metric, and sets those without labels to zero: an alarm on a rise needs a first value. Those with
/// labels are set where the labels are known (`http::begin_metrics`).
fn describe() {
    for &(kind, name, help) in names::ALL.iter().filter(|(_, name, _)| !names::by_hand(name)) {
        let unit = match name {
            _ if name.ends_with("_seconds") => Unit::Seconds,
            _ if name.ends_with("_bytes") => Unit::Bytes,
            _ => Unit::Count,
        };
        match kind {
            Kind::Counter => describe_counter!(name, unit, help),
            Kind::Gauge => describe_gauge!(name, unit, help),
            Kind::Histogram => describe_histogram!(name, unit, help),
        }
    }
    for name in
        [names::PREDICTED_SAMPLES, names::DEADLINES, names::LEASES_LOST, names::MODEL_LOADS, names::PANICS]
    {
        metrics::counter!(name).increment(0);
    }
    metrics::gauge!(names::CONNECTIONS).set(0.0);
    metrics::gauge!(names::CLOCK_OFFSET).set(0.0);
    metrics::gauge!(names::BUILD_INFO, "version" => crate::VERSION).set(1.0);
}

/// Writes a computed metric in Prometheus' text format: its description, then a line for each series with labels
/// (in braces, escaped) and value.
pub fn write_by_hand(text: &mut String, name: &str, series: &[(String, f64)]) {
    let Some((kind, _, help)) = names::ALL.iter().find(|metric| metric.1 == name) else { return };
    let kind = match kind {
        Kind::Counter => "counter",
        Kind::Gauge => "gauge",
        Kind::Histogram => "histogram",
    };
    // Writing to a string cannot fail.
    let _ = writeln!(text, "# HELP {name} {help}\n# TYPE {name} {kind}");
    for (labels, value) in series {
        let _ = writeln!(text, "{name}{labels} {value}");
    }
}

/// Counts panics, including those that are caught.
fn count_panics() {
    let before = std::panic::take_hook();
    std::panic::set_hook(Box::new(move |info| {
        metrics::counter!(names::PANICS).increment(1);
        before(info);
    }));
}

#[cfg(test)]
mod tests {
    use std::sync::{Arc, Mutex};

    use super::*;

    #[derive(Clone, Default)]
    struct Lines(Arc<Mutex<Vec<u8>>>);

    impl std::io::Write for Lines {
        fn write(&mut self, bytes: &[u8]) -> std::io::Result<usize> {
            self.0.lock().unwrap().extend_from_slice(bytes);
            Ok(bytes.len())
        }

        fn flush(&mut self) -> std::io::Result<()> {
            Ok(())
        }
    }

    #[test]
    fn whatever_a_name_holds_a_log_line_stays_one_line() {
        let lines = Lines::default();
        let writer = lines.clone();
        let subscriber = tracing_subscriber::fmt()
            .with_ansi(false)
            .fmt_fields(text_fields())
            .with_writer(move || writer.clone())
            .finish();
        let hostile = "a\nERROR forged\r\u{1b}[2J\u{7}\u{9b}\u{2028}\u{202e}\u{85}b";
        tracing::subscriber::with_default(subscriber, || {
            let span =
                tracing::info_span!("request", run.name = %hostile, http.status = tracing::field::Empty);
            span.record("http.status", 200);
            let error = std::io::Error::other(hostile);
            span.in_scope(|| tracing::info!(%error, name = hostile, "hello {hostile}"));
        });
        let text = String::from_utf8(lines.0.lock().unwrap().clone()).unwrap();
        assert_eq!(text.lines().count(), 1, "{text:?}");
        assert!(text.trim_end_matches('\n').chars().all(|c| !c.is_control()), "{text:?}");
        assert!(!text.contains(['\u{2028}', '\u{202e}']), "{text:?}");
        assert!(text.contains("http.status=200") && text.contains("hello a\\nERROR forged"), "{text:?}");
        assert_eq!(text.matches("forged").count(), 4, "{text:?}");
    }
}
