//! The service as clients see it: every test starts one on a free port with a data directory of
//! its own, and every answer is held against `openapi.yaml`.

mod backups;
mod bad_input;
mod bad_runs;
mod contract;
mod damage;
mod diagnoses;
mod doors;
mod fits;
mod flips;
mod full_disk;
mod idempotency;
mod isa;
mod jobs;
mod kills;
mod models;
mod operations;
mod overload;
mod predictions;
mod problems;
mod readme;
mod rigs;
mod runs;
mod service;
mod shutdown;
mod stops;
mod support;
mod torch;
mod workers;
