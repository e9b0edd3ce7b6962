//! A service inside this process, on a free port and in a temporary directory unless told.

use std::net::SocketAddr;
use std::path::{Path, PathBuf};

use tempfile::TempDir;
use tokio::sync::oneshot;
use tokio::task::JoinHandle;

use super::DemoError;
use crate::app::{Address, App, AppError};
use crate::config::Config;

/// A running service. It is reached over HTTP only; dropping it without [`LocalService::stop`]
/// leaves its jobs unfinished.
pub struct LocalService {
    address: SocketAddr,
    data_dir: PathBuf,
    /// Deletes the directory when the service is gone.
    _temporary: Option<TempDir>,
    shutdown: oneshot::Sender<()>,
    task: JoinHandle<()>,
}

impl LocalService {
    /// Starts a service; `data_dir` left out is a temporary directory that goes with it.
    ///
    /// # Errors
    /// A directory or address that cannot be used.
    pub async fn start(listen: SocketAddr, data_dir: Option<PathBuf>) -> Result<Self, DemoError> {
        let temporary = if data_dir.is_none() { Some(TempDir::with_prefix("rigcast-")?) } else { None };
        let data_dir = data_dir
            .or_else(|| temporary.as_ref().map(|t| t.path().to_owned()))
            .expect("a directory was given or has been made");
        let config = Config::new(data_dir.clone(), listen);
        let address = Address::take(listen).map_err(AppError::from)?;
        let app = App::build(&config).await?;
        let listener = address.listen().map_err(AppError::from)?;
        let address = listener.local_addr()?;
        let (shutdown, told) = oneshot::channel();
        let task = tokio::spawn(app.serve(listener, async move {
            // A dropped sender means stop too.
            let _ = told.await;
        }));
        Ok(Self { address, data_dir, _temporary: temporary, shutdown, task })
    }

    /// Its URL, such as `http://127.0.0.1:40001`.
    pub fn url(&self) -> String {
        format!("http://{}", self.address)
    }

    /// Its data directory.
    pub fn data_dir(&self) -> &Path {
        &self.data_dir
    }

    /// Stops it cleanly.
    ///
    /// # Errors
    /// When the service's task has panicked.
    pub async fn stop(self) -> Result<(), DemoError> {
        drop(self.shutdown);
        Ok(self.task.await.map_err(std::io::Error::other)?)
    }
}
