//! The Open Inference Protocol (KServe V2) under `/v2`, with the extension for binary tensors: clients of
//! KServe and Triton list, check and ask the models without knowing this service.
//!
//! A model of the protocol is a rig: its active version, or the one that the path names. [`layout`] makes
//! tensors of channels, [`service`] and [`describe`] answer about the service and its models, [`infer`]
//! predicts: [`body`] and [`request`] read the request, [`drive`] checks it, [`answer`] writes the response.
//! A prediction takes the same way to the engine, under the same limits, as [`super::predict`].

mod answer;
mod body;
mod describe;
mod drive;
mod infer;
mod layout;
mod named;
mod request;
mod service;
mod values;

pub use describe::{config, metadata, ready as model_ready};
pub use infer::infer;
pub use service::{index, live, ready, server};
