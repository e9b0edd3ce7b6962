//! PostgreSQL: any number of processes on any machines share it.
//!
//! Writers take one lock of the whole database, for the time of a transaction, as they queue for SQLite's one writer:
//! rows that a transaction has read cannot change before it writes, whichever process does it.

use std::fmt;
use std::path::PathBuf;
use std::pin::Pin;
use std::str::FromStr as _;
use std::time::Duration;

use jiff::Timestamp;
use serde::{Deserialize, Serialize};
use sqlx::migrate::MigrateError;
use sqlx::postgres::{PgConnectOptions, PgListener, PgPoolOptions};
use sqlx::{Connection as _, PgConnection, PgPool};
use uuid::Uuid;

use super::statement::{Session, sql};
use crate::storage::{StoreError, migrations};

/// Where a PostgreSQL is.
#[derive(Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct PostgresSettings {
    /// `postgres://user@host/database`; a password may be in it, or in `PGPASSWORD` or `PGPASSFILE`.
    pub url: String,
}

/// Without the URL, which may hold a password.
impl fmt::Debug for PostgresSettings {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str("PostgresSettings")
    }
}

/// Connections of a service that write, and as many that read.
const SERVICE: u32 = 8;

/// Connections of a service that wait while an object is stored: more than uploads have turns.
const HOLDERS: u32 = 24;

/// How long a connection that nobody used is taken without asking whether it still is one. A database takes longer to start
/// again.
const UNTESTED: Duration = Duration::from_millis(100);

/// How long a connection that nobody uses stays.
const IDLE: Duration = Duration::from_secs(60);

/// Connections of the process of a job, which only reads.
const JOB: u32 = 2;

/// How long a request waits for a connection, and a statement for a lock.
const PATIENCE: Duration = Duration::from_secs(5);

/// How long nothing may come from a process while no other one can write: others wait longer than that for their turn.
const HELD: Duration = Duration::from_secs(4);

/// How long the database has for a statement. Longer: the way to it is cut, which nobody is told on an open connection.
const ANSWER: Duration = Duration::from_secs(15);

/// How long a listener hears nothing until it asks whether its connection still is one.
const UNHEARD: Duration = Duration::from_secs(15);

/// Channel of the changes of jobs, which a trigger announces.
const JOBS: &str = "rigcast_jobs";

/// Keys of the advisory locks.
mod locks {
    /// Held to migrate.
    pub(super) const MIGRATE: i64 = 0x5249_4743_0001;
    /// Held while a transaction writes.
    pub(super) const WRITE: i64 = 0x5249_4743_0002;
    /// Held to hold active models against new runs.
    pub(super) const DRIFT: i64 = 0x5249_4743_0004;
}

/// An opened database.
pub(in crate::storage) struct Opened {
    pub(in crate::storage) writers: PgPool,
    pub(in crate::storage) readers: PgPool,
    /// For transactions that begin before an object is stored.
    pub(in crate::storage) holders: PgPool,
    /// Which service it belongs to.
    pub(in crate::storage) service: Uuid,
}

impl PostgresSettings {
    /// Host and name of the database, for people.
    ///
    /// # Errors
    /// [`StoreError::Postgres`] for a URL that is none.
    pub fn name(&self) -> Result<String, StoreError> {
        Ok(name(&self.options()?))
    }

    fn options(&self) -> Result<PgConnectOptions, StoreError> {
        // The parser's own message may repeat the URL.
        let refused = || StoreError::Postgres {
            database: "--database".into(),
            what: "write postgres://user@host:port/database".into(),
        };
        let is_one = ["postgres://", "postgresql://"].iter().any(|scheme| self.url.starts_with(scheme));
        let options = if is_one { PgConnectOptions::from_str(&self.url).ok() } else { None };
        let patience = format!("{}s", PATIENCE.as_secs());
        let options = options.ok_or_else(refused)?;
        Ok(options.application_name("rigcast").options([
            ("lock_timeout", patience.as_str()),
            // A machine that is cut off cannot end what it had begun: the database does, within half a minute.
            ("tcp_keepalives_idle", "10s"),
            ("tcp_keepalives_interval", "5s"),
            ("tcp_keepalives_count", "3"),
            ("tcp_user_timeout", "25s"),
        ]))
    }

    /// Opens the database and brings its schema up to this program's.
    ///
    /// # Errors
    /// [`StoreError::Postgres`] if it cannot be reached or used, [`StoreError::Newer`] for a newer schema.
    pub(in crate::storage) async fn open(&self) -> Result<Opened, StoreError> {
        let options = self.options()?;
        let refused = |what| StoreError::Postgres { database: name(&options), what };
        let connecting = tokio::time::timeout(PATIENCE, PgConnection::connect_with(&options)).await;
        let mut connection = connecting
            .map_err(|_| refused(format!("no answer within {} s", PATIENCE.as_secs())))?
            .map_err(|error| refused(in_words(&error)))?;
        migrate(&mut connection, &name(&options)).await?;
        let service: String = sqlx::query_scalar("SELECT id FROM service")
            .fetch_one(&mut connection)
            .await
            .map_err(|error| refused(in_words(&error)))?;
        connection.close().await?;
        let bad = |error: uuid::Error| StoreError::Row {
            table: "service",
            key: service.clone(),
            what: error.to_string(),
        };
        Ok(Opened {
            writers: pool(SERVICE, options.clone()),
            holders: pool(HOLDERS, options.clone()),
            readers: pool(SERVICE, options.clone().options([("default_transaction_read_only", "on")])),
            service: service.parse().map_err(bad)?,
        })
    }

    /// Opens the database to read from it.
    ///
    /// # Errors
    /// [`StoreError::Postgres`] for a URL that is none.
    pub(in crate::storage) fn open_to_read(&self) -> Result<PgPool, StoreError> {
        Ok(pool(JOB, self.options()?.options([("default_transaction_read_only", "on")])))
    }
}

fn pool(most: u32, options: PgConnectOptions) -> PgPool {
    let pools = PgPoolOptions::new().max_connections(most).acquire_timeout(PATIENCE).idle_timeout(IDLE);
    // A question before each statement would double the way of a prediction to the database and back.
    let pools = pools.test_before_acquire(false).before_acquire(|connection, known| {
        Box::pin(async move {
            if known.idle_for > UNTESTED {
                connection.ping().await?;
            }
            Ok(true)
        })
    });
    // The pool's own question has no limit: connections on which nothing comes back would never leave it.
    let pools = pools.after_release(|connection, _| {
        Box::pin(async move { within(PATIENCE, Box::pin(connection.ping())).await.map(|()| true) })
    });
    pools.connect_lazy_with(options)
}

/// A question to the database on the heap: a timer around each of them would make the futures of a request too large for
/// the stack.
type Asked<'a, T> = Pin<Box<dyn Future<Output = sqlx::Result<T>> + Send + 'a>>;

/// What the database answers, or an error if it does not.
pub(super) async fn answered<T>(asked: Asked<'_, T>) -> sqlx::Result<T> {
    within(ANSWER, asked).await
}

async fn within<T>(limit: Duration, asked: Asked<'_, T>) -> sqlx::Result<T> {
    let late = || std::io::Error::new(std::io::ErrorKind::TimedOut, "the database does not answer");
    tokio::time::timeout(limit, asked).await.unwrap_or_else(|_| Err(late().into()))
}

fn name(options: &PgConnectOptions) -> String {
    let database = options.get_database().unwrap_or_else(|| options.get_username());
    format!("postgres://{}:{}/{database}", options.get_host(), options.get_port())
}

/// Brings the schema up to this program's, while no other process does.
async fn migrate(connection: &mut PgConnection, database: &str) -> Result<(), StoreError> {
    let refused =
        |what: &sqlx::Error| StoreError::Postgres { database: database.to_owned(), what: in_words(what) };
    let lock = "SELECT pg_advisory_lock($1)";
    sqlx::query(lock).bind(locks::MIGRATE).execute(&mut *connection).await.map_err(|e| refused(&e))?;
    let known = migrations::latest();
    let migrated = match migrations::postgres().run(&mut *connection).await {
        Err(MigrateError::VersionMissing(found)) if found > known => {
            Err(StoreError::Newer { path: PathBuf::from(database), found, known })
        }
        Err(MigrateError::Execute(error) | MigrateError::ExecuteMigration(error, _)) => Err(refused(&error)),
        done => done.map_err(StoreError::Migrate),
    };
    let unlock = "SELECT pg_advisory_unlock($1)";
    sqlx::query(unlock).bind(locks::MIGRATE).execute(connection).await.map_err(|e| refused(&e))?;
    migrated
}

/// Lets no one else write until the transaction ends. The database ends it if nothing comes for a while: its machine may be
/// cut off, or stand still.
pub(in crate::storage) async fn write_alone(session: &mut Session) -> sqlx::Result<()> {
    sql("SELECT pg_advisory_xact_lock($1), set_config('idle_in_transaction_session_timeout', $2, true)")
        .bind(locks::WRITE)
        .bind(format!("{}s", HELD.as_secs()))
        .execute(session)
        .await
        .map(drop)
}

/// Lets no one remove an object until the transaction ends.
pub(in crate::storage) async fn keep_object(session: &mut Session, digest: &str) -> sqlx::Result<()> {
    sql("SELECT pg_advisory_xact_lock_shared($1)").bind(lock_of(digest)).execute(session).await.map(drop)
}

/// Lets no one store an object until the transaction ends; `false` while somebody does.
pub(in crate::storage) async fn object_alone(session: &mut Session, digest: &str) -> sqlx::Result<bool> {
    sql("SELECT pg_try_advisory_xact_lock($1)").bind(lock_of(digest)).fetch_one(session).await
}

/// The number of an object's lock: the first 64 bits of its digest, in hex.
fn lock_of(digest: &str) -> i64 {
    let first = digest.get(..16).and_then(|hex| u64::from_str_radix(hex, 16).ok());
    first.unwrap_or_default().cast_signed()
}

/// Takes the turn of a kind of work that one process does at a time, until the transaction ends; `false` if another has
/// it.
pub(in crate::storage) async fn take_turn(session: &mut Session) -> sqlx::Result<bool> {
    sql("SELECT pg_try_advisory_xact_lock($1)").bind(locks::DRIFT).fetch_one(session).await
}

/// Calls `heard` with state and id of each job that any process queues or changes, until the connection fails.
pub(in crate::storage) async fn hear_of_jobs(
    pool: &PgPool,
    mut heard: impl FnMut(&str, &str),
) -> sqlx::Result<()> {
    let mut listener = PgListener::connect_with(pool).await?;
    listener.listen(JOBS).await?;
    loop {
        match tokio::time::timeout(UNHEARD, listener.try_recv()).await {
            Ok(told) => {
                let Some(told) = told? else { return Ok(()) };
                if let Some((state, id)) = told.payload().split_once(' ') {
                    heard(state, id);
                }
            }
            Err(_) => {
                within(PATIENCE, Box::pin(sqlx::query("SELECT 1").execute(&mut listener))).await?;
            }
        }
    }
}

/// Sets which service the database belongs to.
pub(in crate::storage) async fn set_service(session: &mut Session, service: Uuid) -> sqlx::Result<()> {
    sql("UPDATE service SET id = $1").bind(service.to_string()).execute(session).await.map(drop)
}

/// Number of connections that other processes of this program have to the database.
pub(in crate::storage) async fn others(pool: &PgPool) -> Result<i64, StoreError> {
    let count = "SELECT count(*) FROM pg_stat_activity
                 WHERE datname = current_database() AND application_name = 'rigcast' AND pid <> pg_backend_pid()";
    Ok(answered(Box::pin(sqlx::query_scalar(count).fetch_one(pool))).await?)
}

/// The time by the database's clock.
pub(in crate::storage) async fn time(pool: &PgPool) -> Result<Timestamp, StoreError> {
    let asked = sqlx::query_scalar("SELECT (extract(epoch FROM clock_timestamp()) * 1000000)::bigint");
    let us: i64 = answered(Box::pin(asked.fetch_one(pool))).await?;
    let bad =
        |error: jiff::Error| StoreError::Row { table: "clock", key: us.to_string(), what: error.to_string() };
    Timestamp::from_microsecond(us).map_err(bad)
}

/// The cause, without what was sent.
fn in_words(error: &sqlx::Error) -> String {
    match error {
        sqlx::Error::Database(error) => error.message().to_owned(),
        sqlx::Error::Io(error) => error.to_string(),
        sqlx::Error::PoolTimedOut => "no connection in time".into(),
        other => other.to_string(),
    }
}
