//! A folder of measured data with its `about.json`.

use std::path::{Path, PathBuf};

use rigcast::engine::Signal;
use rigcast::engine::model::Preprocess;
use rigcast::engine::resample::resample;
use rigcast::formats::csv;
use rigcast::formats::npy::{self, Dtype, Order};
use serde_json::{Value, json};

type AnyError = Box<dyn std::error::Error>;

/// Sample rate and band that users of the shaker data agree on (its `usual_preprocessing`).
const SHAKER_RATE_HZ: f64 = 4096.0;
const SHAKER_BAND_HZ: [f64; 2] = [12.0, 1250.0];

/// Samples at either end of a training run that are distorted by its filters.
const SHAKER_EDGE: usize = 128;

/// The name of a method and its error in each published column.
pub type PublishedMethod = (String, Vec<Option<f64>>);

/// A file as it is uploaded: name, media type, bytes.
pub type Upload = (String, &'static str, Vec<u8>);

/// The folder; measured files are read on demand.
pub struct Dataset {
    folder: PathBuf,
    id: String,
    about: Value,
    train: Option<String>,
}

/// Name for the first half of every training run.
const HALVES: &str = "halves";

/// One file that no fit has seen.
pub struct TestFile {
    /// Its name in `about.json`.
    pub name: String,
    /// Measured drives, `[input][sample]`.
    pub drive: Vec<Vec<f64>>,
    /// Measured responses, `[output][sample]`.
    pub response: Vec<Vec<f64>>,
}

impl TestFile {
    /// The drive as an NPY file, `[samples, inputs]`.
    pub fn drive_npy(&self) -> Result<Vec<u8>, AnyError> {
        Ok(npy::write(&self.drive, Dtype::F8, Order::C)?)
    }
}

impl Dataset {
    /// Reads `about.json`. `train` names the run of the shaker that is trained on (`run1` if left out), or
    /// `halves`, the first half of each; the rest is what tests.
    pub fn open(folder: &Path, train: Option<&str>) -> Result<Self, AnyError> {
        let path = folder.join("about.json");
        let text = std::fs::read_to_string(&path).map_err(|e| format!("{}: {e}", path.display()))?;
        let folder = folder.canonicalize()?;
        let id = folder.file_name().ok_or("a folder has a name")?.to_string_lossy().to_lowercase();
        let data = Self { about: serde_json::from_str(&text)?, folder, id, train: train.map(String::from) };
        match train {
            Some(name) if name != HALVES && !(data.is_shaker() && data.runs().any(|run| run == name)) => {
                Err(format!("the data have no training run {name:?}").into())
            }
            Some(_) if !data.is_shaker() => Err("these data name their own training and test files".into()),
            _ => Ok(data),
        }
    }

    /// Names of the runs.
    fn runs(&self) -> impl Iterator<Item = &str> {
        self.about["runs"].as_object().into_iter().flatten().map(|(name, _)| name.as_str())
    }

    /// Rig id: the folder's name.
    pub fn id(&self) -> &str {
        &self.id
    }

    /// Sample rate at which the rig is modelled.
    pub fn sample_rate_hz(&self) -> f64 {
        if self.is_shaker() {
            SHAKER_RATE_HZ
        } else {
            self.about["sample_rate_hz"].as_f64().unwrap_or(f64::NAN)
        }
    }

    /// Samples that are left out of published scores.
    pub fn skip(&self) -> usize {
        self.about["skip_first_samples_in_scores"].as_u64().unwrap_or(0) as usize
    }

    /// Factor and unit of errors in print: volts as millivolts, like the published figures.
    pub fn display_unit(&self) -> (f64, String) {
        match self.about["response"][0]["unit"].as_str() {
            Some("V") => (1000.0, "mV".into()),
            Some(unit) => (1.0, unit.into()),
            None => (1.0, "1".into()),
        }
    }

    /// Published figures: column names, and per method one value a column.
    pub fn published(&self) -> (Vec<String>, Vec<PublishedMethod>) {
        let published = &self.about["published_rmse_mV"];
        let columns = strings(&published["columns"]);
        let methods = published.as_object().into_iter().flatten().filter(|(name, _)| *name != "columns");
        let rows = methods.map(|(name, values)| {
            (name.replace('_', " "), values.as_array().into_iter().flatten().map(Value::as_f64).collect())
        });
        (columns, rows.collect())
    }

    /// Published NRMSE per output of a linear FRF, where the data set has that.
    pub fn published_nrmse(&self) -> Vec<f64> {
        let values = self.about["linear_FRF_NRMSE_on_training"].as_array();
        values.into_iter().flatten().filter_map(Value::as_f64).collect()
    }

    /// The rig as `POST /v1/rigs` takes it.
    pub fn rig(&self) -> Value {
        let channel = |name: &str, unit: &str, role: &str, quantity: &str| json!({"name": name, "unit": unit, "role": role, "quantity": quantity});
        let channels: Vec<Value> = if self.is_shaker() {
            let inputs = (1..=9).map(|i| channel(&format!("input_{i}"), "1", "drive", "acceleration"));
            let outputs = (1..=3).map(|i| channel(&format!("output_{i}"), "1", "response", "acceleration"));
            inputs.chain(outputs).collect()
        } else {
            let of = |role: &str| -> Vec<Value> {
                let named = self.about[role].as_array().into_iter().flatten();
                named
                    .map(|c| {
                        channel(
                            c["name"].as_str().unwrap_or(role),
                            c["unit"].as_str().unwrap_or("1"),
                            role,
                            "other",
                        )
                    })
                    .collect()
            };
            [of("drive"), of("response")].concat()
        };
        json!({"id": self.id, "name": self.about["system"], "sample_rate_hz": self.sample_rate_hz(), "channels": channels})
    }

    /// Training files as they are uploaded: name, media type, bytes.
    pub fn training(&self) -> Result<Vec<Upload>, AnyError> {
        if self.is_shaker() {
            let upload = |(name, run): (String, Signal)| {
                let run = run.slice(SHAKER_EDGE..run.n_samples() - SHAKER_EDGE);
                Ok((name, "application/x-npy", npy::write(run.channels(), Dtype::F8, Order::C)?))
            };
            return self.shaker_parts(true)?.into_iter().map(upload).collect();
        }
        let path = self.folder.join("train.csv");
        Ok(vec![("train".into(), "text/csv", std::fs::read(path)?)])
    }

    /// All test files.
    pub fn tests(&self) -> Result<Vec<TestFile>, AnyError> {
        if self.is_shaker() {
            let file = |(name, signal): (String, Signal)| {
                let mut channels = signal.into_channels();
                let response = channels.split_off(9);
                TestFile { name, drive: channels, response }
            };
            return Ok(self.shaker_parts(false)?.into_iter().map(file).collect());
        }
        let mut names: Vec<String> = self.runs().map(String::from).collect();
        names.retain(|name| name.starts_with("test"));
        let order = self.published().0;
        names.sort_by_key(|name| order.iter().position(|o| o == name));
        names
            .into_iter()
            .map(|name| {
                let bytes = std::fs::read(self.folder.join(format!("{name}.csv")))?;
                let mut channels = csv::read(&bytes)?.channels;
                let n_drives = self.about["drive"].as_array().map_or(1, Vec::len);
                let response = channels.split_off(n_drives);
                Ok(TestFile { name, drive: channels, response })
            })
            .collect()
    }

    fn is_shaker(&self) -> bool {
        self.about["array"].is_string()
    }

    /// What of the shaker's runs is trained on, or what is left for tests.
    fn shaker_parts(&self, training: bool) -> Result<Vec<(String, Signal)>, AnyError> {
        let train = self.train.as_deref().unwrap_or("run1");
        let part = |name: &str| -> Result<(String, Signal), AnyError> {
            let run = self.shaker(name)?;
            let (n, half) = (run.n_samples(), run.n_samples() / 2);
            Ok(match (train == HALVES, training) {
                (true, true) => (name.into(), run.slice(0..half)),
                (true, false) => (format!("second half of {name}"), run.slice(half..n)),
                (false, _) => (name.into(), run),
            })
        };
        let wanted = |name: &&str| train == HALVES || (*name == train) == training;
        self.runs().filter(wanted).map(part).collect()
    }

    /// One shaker run, resampled with an anti-alias filter and band-passed.
    fn shaker(&self, name: &str) -> Result<Signal, AnyError> {
        let run = npy::read(&std::fs::read(self.folder.join(format!("{name}.npy")))?)?;
        let rate_hz = self.about["sample_rate_hz"].as_f64().ok_or("about.json lacks sample_rate_hz")?;
        let slow = resample(&Signal::new(rate_hz, run.channels)?, SHAKER_RATE_HZ)?;
        let band = Preprocess { low_pass_hz: None, band_pass_hz: Some(SHAKER_BAND_HZ) };
        Ok(band.apply(&slow)?)
    }
}

fn strings(value: &Value) -> Vec<String> {
    value.as_array().into_iter().flatten().filter_map(Value::as_str).map(String::from).collect()
}
