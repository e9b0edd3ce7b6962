//! Receives a request in each of its forms and makes a task of it: JSON, NPY, a measurement file.

use axum::body::Body;
use axum::http::HeaderMap;

use super::answer::PredictionTask;
use super::conversion::Conversion;
use super::form::Form;
use super::inputs::{self, Drive, Target};
use super::request::{FileRequest, MeasurementQuery, NpyQuery, PredictRequest};
use super::{Stages, find, needed};
use crate::compute::Class;
use crate::domain::RigId;
use crate::engine::Samples;
use crate::formats::Format;
use crate::http::body::source::Source;
use crate::http::negotiate::{CSV, MAT, NPY, RPC3};
use crate::http::params::Params;
use crate::http::problem::Answer;
use crate::http::{Shared, admission, body, json, measurement, upload};
use crate::models::LoadedModel;

/// A request before its body.
pub struct Incoming {
    /// The rig.
    pub rig: RigId,
    /// Its query.
    pub params: Params,
    /// Its headers.
    pub headers: HeaderMap,
    /// Its body.
    pub body: Body,
}

impl Incoming {
    /// A JSON document that holds the whole request.
    ///
    /// # Errors
    /// Those of the body, the model, the drive and the target.
    pub async fn json(mut self, http: &Shared, stages: &mut Stages) -> Answer<PredictionTask> {
        let resample = self.params.flag("resample")?;
        self.params.finish()?;
        let form = Form::choose(&self.headers, json::MEDIA_TYPE)?;
        let request: PredictRequest = json::take_signals(&self.headers, self.body, http).await?;
        stages.end("receive");
        let (rig, model) = find(http, &self.rig, request.model).await?;
        let include = request.includes()?;
        let fallback = request.fallback.is_frf_of(model.model(), "/fallback")?;
        let drive = inputs::find(http, &self.rig, request.drive, "/drive").await?;
        let target = match request.target {
            Some(source) => Some(inputs::find(http, &self.rig, source, "/target").await?),
            None => None,
        };
        let to = Conversion::to_rate_of(model.model(), resample);
        let bytes = to.bytes(&model, drive.n_samples(), drive.sample_rate_hz(), target.is_some())?;
        let memory = http.predictions.take(admission::client_id(), bytes).await?;
        let drive = inputs::drive(http, drive, &model).await?;
        let target = match target {
            Some(found) => Some(inputs::target(http, found, &model).await?),
            None => None,
        };
        stages.end("load");
        let damage = request.damage.unwrap_or_default();
        Ok(PredictionTask {
            rig,
            model,
            drive,
            target,
            include,
            damage,
            fallback,
            form,
            conversion: to,
            memory,
        })
    }

    /// An NPY file with the drives.
    ///
    /// # Errors
    /// Those of the query, the model and the target; the file is parsed later.
    pub async fn npy(self, http: &Shared, stages: &mut Stages) -> Answer<PredictionTask> {
        let NpyQuery { request, sample_rate_hz, resample } = NpyQuery::take(self.params)?;
        let form = Form::choose(&self.headers, NPY)?;
        let limits = &http.limits;
        let bytes = body::Limited::new(&self.headers, self.body, limits.drive_bytes, limits.pace)?;
        let bytes = bytes.collect().await?;
        stages.end("receive");
        let FileRequest { model, target, include, damage, fallback } = request;
        let (rig, model) = find(http, &self.rig, model).await?;
        let fallback = fallback.is_frf_of(model.model(), "?fallback")?;
        let drive = Drive::Npy { bytes, sample_rate_hz };
        let samples = drive.n_samples(model.model().inputs.len());
        let to = Conversion::to_rate_of(model.model(), resample);
        let bytes = to.bytes(&model, samples, sample_rate_hz, target.is_some())?;
        let memory = http.predictions.take(admission::client_id(), bytes).await?;
        let target = stored(http, &self.rig, target, &model).await?;
        stages.end("load");
        Ok(PredictionTask {
            rig,
            model,
            drive,
            target,
            include,
            damage,
            fallback,
            form,
            conversion: to,
            memory,
        })
    }

    /// A measurement file with the drive among its channels.
    ///
    /// # Errors
    /// Those of the query, the file, the model and the target.
    pub async fn measurement(
        self,
        http: &Shared,
        media_type: Option<&str>,
        stages: &mut Stages,
    ) -> Answer<PredictionTask> {
        // General types are not looked into here: they would hide an NPY file without its rate.
        let Some(format) = measurement::format(media_type)? else {
            return Err(body::unsupported(media_type, &measurement::OFFERED));
        };
        let MeasurementQuery { request, file } = MeasurementQuery::take(self.params)?;
        let own = match format {
            Format::Rpc3 => RPC3,
            Format::Mat => MAT,
            _ => CSV,
        };
        let form = Form::choose(&self.headers, own)?;
        let FileRequest { model, target, include, damage, fallback } = request;
        let (rig, model) = find(http, &self.rig, model).await?;
        let fallback = fallback.is_frf_of(model.model(), "?fallback")?;
        let upload = upload::receive_at_most(http, http.limits.drive_bytes, &self.headers, self.body).await?;
        stages.end("receive");
        let (class, scratch) = (Class::of_bytes(upload.size()), http.store.scratch_dir());
        let of_rig = rig.clone();
        let read = move || file.read(&of_rig, Some(format), upload, &scratch);
        let measurement = http.off_thread(class, read).await??;
        // The file's reader has converted it, if that was asked for.
        let mut conversion = Conversion::to_rate_of(model.model(), false);
        conversion.note_drive(measurement.sample_rate_hz, measurement.samples.sample_rate_hz());
        let samples = measurement.samples.n_samples();
        if !conversion.made().is_none() {
            conversion.check_size(&model, samples)?;
        }
        let bytes = needed(&model, samples, target.is_some());
        let memory = http.predictions.take(admission::client_id(), bytes).await?;
        let of_model = model.clone();
        let drive = http.off_thread(class, move || inputs::measured(measurement, &of_model)).await??;
        let target = stored(http, &self.rig, target, &model).await?;
        stages.end("load");
        Ok(PredictionTask { rig, model, drive, target, include, damage, fallback, form, conversion, memory })
    }
}

/// The target of a request whose body is a file.
async fn stored(
    http: &Shared,
    rig: &RigId,
    source: Option<Source>,
    model: &LoadedModel,
) -> Answer<Option<Target>> {
    let Some(source) = source else { return Ok(None) };
    let found = inputs::find(http, rig, source, "?target").await?;
    inputs::target(http, found, model).await.map(Some)
}
