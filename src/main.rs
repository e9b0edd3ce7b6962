//! The `rigcast` program. All of it is in the library, so that it is compiled once.

use std::process::ExitCode;

use clap::Parser;
use rigcast::config::Cli;

fn main() -> ExitCode {
    rigcast::program::run(Cli::parse().command)
}
