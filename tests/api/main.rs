//! The service as clients see it: every test starts one on a free port with a data directory of
//! its own, and every answer is checked against `openapi.yaml`.

mod auth;
mod backups;
mod bad_input;
mod bad_runs;
mod choice;
mod command_line;
mod comparisons;
mod contract;
mod damage;
mod diagnoses;
mod docs;
mod fits;
mod flips;
mod frf;
mod full_disk;
mod idempotency;
mod isa;
mod jobs;
mod kills;
mod logs;
mod models;
mod operations;
mod overload;
mod predictions;
mod problems;
mod request_bodies;
mod rigs;
mod runs;
mod service;
mod shutdown;
mod start;
mod stops;
mod support;
mod torch;
mod workers;
