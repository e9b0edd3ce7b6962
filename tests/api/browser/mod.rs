//! The pages in a browser: Debian's chromium, driven by chromium-driver. Where they are not there, the tests say so and
//! are skipped. Screenshots go to `target/pages/`.

mod comparison;
mod driver;
mod figures;
mod live;
mod names;
mod story;

pub use driver::Browser;

/// Directory of the screenshots.
fn shots() -> std::path::PathBuf {
    let target = std::env::var_os("CARGO_TARGET_DIR").map_or_else(
        || std::path::Path::new(env!("CARGO_MANIFEST_DIR")).join("target"),
        std::path::PathBuf::from,
    );
    target.join("pages")
}
