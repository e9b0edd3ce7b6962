//! Logs and metrics: the two ways in which the service tells how it is doing.
//!
//! Log lines are readable alone and carry dotted fields with the unit in the name; sample data
//! and request bodies never enter them. Metrics are Prometheus', in seconds and bytes.

pub mod names;

use std::fmt;
use std::sync::OnceLock;

use metrics::{Unit, describe_counter, describe_gauge, describe_histogram};
use metrics_exporter_prometheus::{Matcher, PrometheusBuilder, PrometheusHandle};
use names::Kind;
use tracing_subscriber::EnvFilter;
use tracing_subscriber::field::MakeExt;
use tracing_subscriber::fmt::FormatFields;
use tracing_subscriber::fmt::format::{Writer, debug_fn};

/// How log lines look.
#[derive(Debug, Clone, Copy, PartialEq, Eq, clap::ValueEnum)]
pub enum LogFormat {
    /// One readable line an event.
    Text,
    /// One JSON object an event.
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
/// A filter that is no list of levels and directives.
pub fn init_logging(filter: &str, format: LogFormat) -> Result<(), LogFilterError> {
    let filter = EnvFilter::try_new(filter)
        .map_err(|e| LogFilterError { filter: filter.to_owned(), reason: e.to_string() })?;
    let builder = tracing_subscriber::fmt().with_env_filter(filter).with_writer(std::io::stderr);
    // Only a second call in one process can fail, and then the first one's logging goes on.
    let _ = match format {
        LogFormat::Text => builder.with_ansi(false).fmt_fields(text_fields()).try_init(),
        LogFormat::Json => builder.json().flatten_event(true).try_init(),
    };
    Ok(())
}

/// Fields on one line, whatever is in them: names that people gave may hold line ends and codes that
/// move a terminal's cursor. (JSON escapes by itself.)
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

/// The text with its control characters escaped, those that only change the direction of text too.
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
/// When other code of the same process has installed a recorder of its own: a bug of ours.
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

/// From a health check to a prediction of an hour, seconds.
const REQUEST_BUCKETS: [f64; 13] =
    [0.001, 0.0025, 0.005, 0.01, 0.025, 0.05, 0.1, 0.25, 0.5, 1.0, 2.5, 10.0, 60.0];
/// From an FRF to a night's LSTM, seconds.
const FIT_BUCKETS: [f64; 9] = [0.1, 1.0, 5.0, 15.0, 60.0, 300.0, 900.0, 3600.0, 14400.0];

/// Says what each metric is, and shows what nothing has happened to yet as zero: an alarm on a rise
/// needs a value to rise from.
fn describe() {
    for &(kind, name, help) in names::ALL {
        let unit = if name.ends_with("_seconds") { Unit::Seconds } else { Unit::Count };
        match kind {
            Kind::Counter => describe_counter!(name, unit, help),
            // One that is written by hand, with its own words.
            Kind::Gauge if name == names::VALIDATION_ERROR => {}
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
    metrics::gauge!(names::BUILD_INFO, "version" => env!("CARGO_PKG_VERSION")).set(1.0);
}

/// Counts panics, wherever they are caught.
fn count_panics() {
    let before = std::panic::take_hook();
    std::panic::set_hook(Box::new(move |info| {
        metrics::counter!(names::PANICS).increment(1);
        before(info);
    }));
}

#[cfg(test)]
mod tests {
    use std::io::Write;
    use std::sync::{Arc, Mutex};

    use super::*;

    #[derive(Clone, Default)]
    struct Lines(Arc<Mutex<Vec<u8>>>);

    impl Write for Lines {
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
