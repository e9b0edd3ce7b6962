//! Every problem code of the contract. `openapi.yaml` lists the same ones; a test compares.

/// A kind of problem: name, status and title, which are the same each time.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Code {
    /// Stable name, for programs.
    pub name: &'static str,
    /// HTTP status.
    pub status: u16,
    /// Title for people, the same for every problem of this kind.
    pub title: &'static str,
}

/// Defines the constants together with the table of all of them, so that neither lacks one.
macro_rules! codes {
    ($($constant:ident = $name:literal, $status:literal, $title:literal;)*) => {
        $(
            #[doc = concat!("`", $name, "`: ", $title, ".")]
            pub const $constant: Code = Code { name: $name, status: $status, title: $title };
        )*

        /// All codes.
        pub const ALL: &[Code] = &[$($constant),*];
    };
}

codes! {
    // The request as such.
    REQUEST_MALFORMED = "request.malformed", 400, "The request cannot be read";
    REQUEST_URI_TOO_LONG = "request.uri_too_long", 414, "The address is too long";
    REQUEST_HEAD_TOO_LARGE = "request.head_too_large", 431, "The headers are too large";
    ROUTE_NOT_FOUND = "route.not_found", 404, "No such route";
    METHOD_NOT_ALLOWED = "method.not_allowed", 405, "Method not allowed";
    ACCEPT_NOT_ACCEPTABLE = "accept.not_acceptable", 406, "No acceptable representation";
    CONTENT_TYPE_UNSUPPORTED = "content_type.unsupported", 415, "Unsupported media type";
    CONTENT_ENCODING_UNSUPPORTED = "content_encoding.unsupported", 415, "Unsupported content encoding";
    QUERY_UNKNOWN_PARAMETER = "query.unknown_parameter", 422, "Unknown query parameter";
    QUERY_INVALID = "query.invalid", 422, "Invalid query parameter";

    // Its body.
    BODY_INCOMPLETE = "body.incomplete", 400, "The body ended early";
    BODY_TOO_SLOW = "body.too_slow", 408, "The body comes too slowly";
    BODY_SYNTAX = "body.syntax", 400, "The body is not JSON";
    BODY_TOO_DEEP = "body.too_deep", 400, "The body is nested too deeply";
    BODY_TOO_LARGE = "body.too_large", 413, "The body is too large";
    BODY_UNKNOWN_FIELD = "body.unknown_field", 422, "Unknown field";
    BODY_MISSING_FIELD = "body.missing_field", 422, "Missing field";
    BODY_INVALID_VALUE = "body.invalid_value", 422, "Invalid value";
    FORM_MALFORMED = "form.malformed", 400, "The form cannot be read";
    FORM_INVALID = "form.invalid", 422, "The form does not hold one file and its description";
    DIGEST_MALFORMED = "digest.malformed", 400, "Content-Digest cannot be read";
    DIGEST_MISMATCH = "digest.mismatch", 400, "The body does not match its digest";

    // Tokens and callers.
    TOKEN_MISSING = "token.missing", 401, "A token is needed";
    TOKEN_INVALID = "token.invalid", 401, "The token is not in force";
    TOKEN_ROLE = "token.role", 403, "The token's role is too low";
    TOKEN_SCOPE = "token.scope", 403, "The token is limited to some rigs";
    HOST_FOREIGN = "host.foreign", 403, "Open to this machine only";
    ORIGIN_FOREIGN = "origin.foreign", 403, "Changes from another origin";
    CSRF_INVALID = "csrf.invalid", 403, "The form is not of this session";
    TOKEN_BUSY = "token.busy", 429, "The token's share is used up";
    TOKEN_NOT_FOUND = "token.not_found", 404, "No such token";
    TOKEN_FIRST_ADMIN = "token.first_admin", 409, "The first token must be an admin's";

    // Preconditions.
    IF_MATCH_MALFORMED = "if_match.malformed", 400, "If-Match cannot be read";
    IF_MATCH_STALE = "if_match.stale", 412, "The resource has changed";
    IF_MATCH_MISSING = "if_match.missing", 428, "If-Match is required";
    IDEMPOTENCY_KEY_MALFORMED = "idempotency_key.malformed", 400, "Idempotency-Key cannot be read";
    IDEMPOTENCY_KEY_IN_USE = "idempotency_key.in_use", 409, "A request under the same key is under way";
    IDEMPOTENCY_KEY_SECRET = "idempotency_key.secret", 409, "The secret was in the first answer only";
    IDEMPOTENCY_KEY_GONE = "idempotency_key.gone", 410, "What was created under the key is deleted";
    IDEMPOTENCY_KEY_REUSED = "idempotency_key.reused", 422, "The key belongs to another request";

    // Rigs.
    RIG_NOT_FOUND = "rig.not_found", 404, "No such rig";
    RIG_EXISTS = "rig.exists", 409, "The rig exists already";
    RIG_CHANNELS_FIXED = "rig.channels_fixed", 409, "Channels are fixed once a run exists";
    RIG_CHANGED = "rig.changed", 409, "The rig changed meanwhile";
    RIG_INVALID = "rig.invalid", 422, "The rig does not make sense";

    // Runs.
    RUN_NOT_FOUND = "run.not_found", 404, "No such run";
    RUN_FITTED_ON = "run.fitted_on", 409, "Models were fitted on the run";
    RUN_INVALID = "run.invalid", 422, "The run does not suit the rig";
    RUN_UNKNOWN_CHANNEL = "run.unknown_channel", 422, "The rig has no such channel";
    RUN_CHANNEL_COUNT = "run.channel_count", 422, "Columns and channel names differ in number";
    RUN_SAMPLE_RATE = "run.sample_rate", 422, "Another sample rate than the rig's";
    RUN_EMPTY = "run.empty", 422, "No samples";
    RUN_NO_CHANNELS = "run.no_channels", 422, "No channels";
    RUN_TOO_MANY_CHANNELS = "run.too_many_channels", 422, "Too many channels";
    RUN_DUPLICATE_CHANNEL = "run.duplicate_channel", 422, "A channel comes twice";
    RUN_UNEQUAL_LENGTHS = "run.unequal_lengths", 422, "Channels differ in length";
    RUN_NON_FINITE = "run.non_finite", 422, "NaN or infinity";

    // Files.
    CSV_HEADER = "csv.header", 422, "The header row is not valid";
    CSV_NOT_A_NUMBER = "csv.not_a_number", 422, "A cell is not a number";
    CSV_AMBIGUOUS_NUMBER = "csv.ambiguous_number", 422, "A mark may begin decimals or group thousands";
    CSV_RAGGED_ROW = "csv.ragged_row", 422, "Rows differ in their number of cells";
    CSV_LONG_ROW = "csv.long_row", 422, "A row is too long";
    CSV_UNEVEN_TIME = "csv.uneven_time", 422, "Time does not rise in even steps";
    CSV_TIME_COLUMN = "csv.time_column", 422, "The time column cannot be read";
    NPY_HEADER = "npy.header", 400, "The NPY header cannot be read";
    NPY_DTYPE = "npy.dtype", 422, "An NPY dtype that is not supported";
    NPY_SHAPE = "npy.shape", 422, "An NPY shape that is not supported";
    NPY_TRUNCATED = "npy.truncated", 400, "The NPY header declares more than the file has";
    NPY_TRAILING_BYTES = "npy.trailing_bytes", 400, "The NPY file has more than its header declares";
    RPC3_HEADER = "rpc3.header", 400, "The RPC III header cannot be read";
    RPC3_UNSUPPORTED = "rpc3.unsupported", 422, "A kind of RPC III file that is not supported";
    RPC3_SIZE = "rpc3.size", 400, "The RPC III header and the size of the file disagree";
    MAT_INVALID = "mat.invalid", 400, "The structure of the MAT file cannot be read";
    NPZ_INVALID = "npz.invalid", 400, "The NPZ archive cannot be read";
    HDF5_INVALID = "hdf5.invalid", 400, "The structure of the HDF5 file cannot be read";
    VARIABLES_UNSUPPORTED = "variables.unsupported", 422, "A variable of the file is no channel and no label";
    VARIABLES_UNEVEN_TIME = "variables.uneven_time", 422, "The times of the file are not even";
    FILE_UNPACKED_SIZE = "file.unpacked_size", 413, "The file is too large when it is unpacked";
    UFF58_HEADER = "uff58.header", 400, "A record of the UFF file cannot be read";
    UFF58_UNSUPPORTED = "uff58.unsupported", 422, "A kind of UFF file that is not supported";
    UFF58_SIZE = "uff58.size", 400, "A UFF data set has another size than its header declares";
    UFF58_NOT_A_NUMBER = "uff58.not_a_number", 422, "Columns of a UFF data set hold no number";
    JSON_INVALID = "json.invalid", 400, "The file is not JSON of the right form";
    JSON_UNKNOWN_FIELD = "json.unknown_field", 422, "Unknown field";
    JSON_DUPLICATE_FIELD = "json.duplicate_field", 422, "A field comes twice";
    JSON_MISSING_FIELD = "json.missing_field", 422, "Missing field";
    JSON_NOT_A_NUMBER = "json.not_a_number", 422, "An element is not a number";

    // Fits and jobs.
    JOB_NOT_FOUND = "job.not_found", 404, "No such job";
    JOB_TOO_MANY_WAITING = "job.too_many_waiting", 429, "Too many jobs of the token wait";
    FIT_NO_RUNS = "fit.no_runs", 409, "No run matches the selection";
    FIT_INVALID = "fit.invalid", 422, "The fit does not suit the rig";
    FIT_MISSING_CHANNEL = "fit.missing_channel", 422, "A run lacks a channel of the fit";
    FIT_TEST_RUN = "fit.test_run", 422, "A test run never enters a fit";
    FIT_MEMORY = "fit.memory", 422, "The fit needs more memory than there is";
    JOB_PANICKED = "job.panicked", 500, "A defect ended the job";
    JOB_INTERRUPTED = "job.interrupted", 500, "The job was interrupted too often";
    JOB_CRASHED = "job.crashed", 500, "The worker process died";
    JOB_MEMORY = "job.memory", 500, "The job took too much memory";
    JOB_TIME_LIMIT = "job.time_limit", 500, "The job took too long";
    JOB_UNKNOWN = "job.unknown", 500, "The job cannot be read";

    // Iterations.
    ITERATION_NOT_FOUND = "iteration.not_found", 404, "No such iteration";
    ITERATION_INVALID = "iteration.invalid", 422, "The iteration does not suit the rig";

    // Evaluations.
    EVALUATION_NOT_FOUND = "evaluation.not_found", 404, "No such evaluation";
    EVALUATION_NO_RUNS = "evaluation.no_runs", 409, "No run matches the selection of the evaluation";
    EVALUATION_INVALID = "evaluation.invalid", 422, "The evaluation does not suit the rig";
    EVALUATION_NO_COMMON_CHANNELS = "evaluation.no_common_channels", 422, "A model and the runs have no channels in common";
    EVALUATION_EMPTY_CLASS = "evaluation.empty_class", 422, "A class of the evaluation has no runs";

    // Studies.
    STUDY_NOT_FOUND = "study.not_found", 404, "No such study";
    STUDY_INVALID = "study.invalid", 422, "The study cannot be done as it is asked for";
    STUDY_NO_TRIAL = "study.no_trial", 422, "No trial of the study came to an end";

    // Diagnoses.
    DIAGNOSIS_NOT_FOUND = "diagnosis.not_found", 404, "No such diagnosis";
    DIAGNOSIS_NO_RUNS = "diagnosis.no_runs", 409, "No run matches the selection of the diagnosis";
    DIAGNOSIS_NO_EFFECT = "diagnosis.no_effect", 409, "The diagnosis names no effect";
    DIAGNOSIS_NO_MODEL = "diagnosis.no_model", 409, "The diagnosis has no model of the rig";
    DIAGNOSIS_UNSTABLE = "diagnosis.unstable", 409, "The effect is not stable over the envelope";
    DIAGNOSIS_INVALID = "diagnosis.invalid", 422, "The diagnosis does not suit the rig";
    DIAGNOSIS_MISSING_CHANNEL = "diagnosis.missing_channel", 422, "A run lacks a channel of the diagnosis";
    DIAGNOSIS_TOO_SHORT = "diagnosis.too_short", 422, "Runs are too short for a diagnosis";
    DIAGNOSIS_NO_HYPOTHESIS = "diagnosis.no_hypothesis", 422, "The diagnosis has no such hypothesis";

    // Models.
    MODEL_NOT_FOUND = "model.not_found", 404, "No such model version";
    MODEL_ACTIVE = "model.active", 409, "The model is active";
    MODEL_NONE_ACTIVE = "model.none_active", 409, "The rig has no active model";
    MODEL_NOT_READY = "model.not_ready", 503, "The rig has no active model to ask";
    MODEL_NO_FRF = "model.no_frf", 409, "The model has no FRF";
    MODEL_NO_COHERENCE = "model.no_coherence", 409, "The model does not carry its coherence";
    MODEL_NOT_FORWARD = "model.not_forward", 422, "The model does not map drives to responses";
    MODEL_UNKNOWN_CHANNEL = "model.unknown_channel", 422, "The rig has no such channel";
    MODEL_SAMPLE_RATE = "model.sample_rate", 422, "Another sample rate than the rig's";
    MODEL_DAMAGED = "model.damaged", 500, "The stored model cannot be read";
    WEIGHTS_MALFORMED = "weights.malformed", 422, "The weight file cannot be read";
    WEIGHTS_SHAPE = "weights.shape", 422, "A tensor has the wrong shape";

    // Predictions and damage.
    PREDICT_MISSING_CHANNEL = "predict.missing_channel", 422, "A channel is missing";
    PREDICT_UNKNOWN_CHANNEL = "predict.unknown_channel", 422, "A channel that the model does not have";
    PREDICT_SAMPLE_RATE = "predict.sample_rate", 422, "Another sample rate than the model's";
    PREDICT_BATCH_SIZE = "predict.batch_size", 422, "Too many drives in one batch";
    PREDICT_UNEQUAL_LENGTHS = "predict.unequal_lengths", 422, "Drive and target differ in length";
    PREDICT_TARGET_MISSING = "predict.target_missing", 422, "Errors need a target";
    PREDICT_NO_FALLBACK = "predict.no_fallback", 422, "The model has no FRF to fall back to";
    PREDICT_BAND_TOO_LONG = "predict.band_too_long", 422, "A band of too many values";
    PREDICT_DEADLINE = "predict.deadline", 504, "The answer was not ready in time";
    DAMAGE_UNKNOWN_CHANNEL = "damage.unknown_channel", 422, "A channel that the request does not have";
    DAMAGE_SAMPLE_RATE = "damage.sample_rate", 422, "Prediction and target differ in sample rate";

    // Tensors of the Open Inference Protocol.
    INFERENCE_HEADER_LENGTH = "inference.header_length", 400, "The length of the JSON does not fit the body";
    INFERENCE_BINARY_SIZE = "inference.binary_size", 400, "The binary data do not fit the body";
    INFERENCE_UNKNOWN_TENSOR = "inference.unknown_tensor", 422, "The model has no such tensor";
    INFERENCE_MISSING_TENSOR = "inference.missing_tensor", 422, "A tensor is missing";
    INFERENCE_DUPLICATE_TENSOR = "inference.duplicate_tensor", 422, "A tensor comes twice";
    INFERENCE_DATATYPE = "inference.datatype", 422, "A datatype that is not supported";
    INFERENCE_SHAPE = "inference.shape", 422, "The shape does not fit the model or the data";

    // Errors of the engine.
    SIGNAL_EMPTY = "signal.empty", 422, "No samples";
    SIGNAL_UNEQUAL_LENGTHS = "signal.unequal_lengths", 422, "Channels differ in length";
    SIGNAL_CHANNEL_COUNT = "signal.channel_count", 422, "Another number of channels";
    SIGNAL_NON_FINITE = "signal.non_finite", 422, "NaN or infinity";
    SIGNAL_SAMPLE_RATE = "signal.sample_rate", 422, "Another sample rate";
    SIGNAL_TOO_SHORT = "signal.too_short", 422, "Too few samples";
    SIGNAL_DEAD_CHANNEL = "signal.dead_channel", 422, "A constant channel where power is needed";
    SETTING_OUT_OF_RANGE = "setting.out_of_range", 422, "A setting outside its limits";
    FRF_TOO_FEW_AVERAGES = "frf.too_few_averages", 422, "Too few averages";
    FRF_DEPENDENT_INPUTS = "frf.dependent_inputs", 422, "Inputs depend on each other";
    TRAINING_DIVERGED = "training.diverged", 422, "Training diverged";
    RESULT_NON_FINITE = "result.non_finite", 422, "The result is not finite";

    // Our side.
    INTERNAL = "internal", 500, "Internal error";
    BUSY = "busy", 503, "Busy";
    DRAINING = "draining", 503, "Shutting down";
    STORE_DAMAGED = "store.damaged", 500, "Stored data are damaged";
    STORE_ROW = "store.row", 503, "A stored row is damaged";
    STORE_UNAVAILABLE = "store.unavailable", 503, "The store is out of reach";
    STORE_FULL = "store.full", 507, "The disk is full";
}

/// The code of this name.
pub fn find(name: &str) -> Option<Code> {
    ALL.iter().copied().find(|code| code.name == name)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn names_are_unique_and_statuses_are_errors() {
        let mut names: Vec<_> = ALL.iter().map(|c| c.name).collect();
        names.sort_unstable();
        names.dedup();
        assert_eq!(names.len(), ALL.len());
        for code in ALL {
            assert!((400..600).contains(&code.status), "{}", code.name);
            assert!(
                axum::http::StatusCode::from_u16(code.status).is_ok_and(|s| s.canonical_reason().is_some())
            );
            assert!(
                code.name
                    .bytes()
                    .all(|b| b.is_ascii_lowercase() || b.is_ascii_digit() || b == b'.' || b == b'_')
            );
        }
    }
}
