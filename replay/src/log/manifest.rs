//! `store.json`: which format a store has, whose transitions it holds, and its name.
//!
//! It lies beside the log, so that any later version can read it before it touches that. It is written once, and a
//! snapshot's is the same.

use crate::error::StoreError;
use getup_proto::RunSpec;
use rand::Rng;
use serde::{Deserialize, Serialize};
use std::fs::{self, File};
use std::io::Write;
use std::path::Path;

/// The format that this version reads and writes.
pub(crate) const FORMAT: u64 = 2;
const FILE: &str = "store.json";

/// The content of `store.json`.
#[derive(Clone, PartialEq, Eq, Debug, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub(crate) struct Manifest {
    pub(super) format: u64,
    /// Names the store, and its snapshots; drawn at its creation, never 0.
    pub(crate) store: u64,
    pub(crate) spec: RunSpec,
}

impl Manifest {
    /// Of a new store.
    pub(crate) fn new(spec: &RunSpec) -> Self {
        Self { format: FORMAT, store: rand::rng().random_range(1..=u64::MAX), spec: spec.clone() }
    }

    /// Of the store in `dir`, where there is one; it must have this format and hold transitions of `spec`.
    pub(crate) fn read(dir: &Path, spec: &RunSpec) -> Result<Option<Self>, StoreError> {
        let manifest = Self::load(dir)?;
        if let Some(manifest) = &manifest {
            spec.check_same(&manifest.spec)
                .map_err(|source| StoreError::OtherRun { dir: dir.to_owned(), source })?;
        }
        Ok(manifest)
    }

    /// Of the store that must be in `dir`, whatever it holds.
    pub(crate) fn existing(dir: &Path) -> Result<Self, StoreError> {
        Self::load(dir)?.ok_or_else(|| StoreError::NoStore { dir: dir.to_owned() })
    }

    /// Of the store in `dir`, where there is one, whatever it holds.
    fn load(dir: &Path) -> Result<Option<Self>, StoreError> {
        let path = dir.join(FILE);
        if !path.try_exists().map_err(StoreError::io("read", &path))? {
            return Ok(None);
        }
        let text = fs::read(&path).map_err(StoreError::io("read", &path))?;
        let damaged =
            |error: serde_json::Error| StoreError::manifest(dir, format!("{FILE} cannot be read ({error})"));
        let value: serde_json::Value = serde_json::from_slice(&text).map_err(damaged)?;
        match value["format"].as_u64() {
            Some(FORMAT) => {}
            Some(found) => return Err(StoreError::Format { dir: dir.to_owned(), found, ours: FORMAT }),
            None => return Err(StoreError::manifest(dir, format!("{FILE} names no format"))),
        }
        serde_json::from_value(value).map(Some).map_err(damaged)
    }

    /// Writes it under a temporary name, then renames: it is there whole, or not at all.
    pub(crate) fn write(&self, dir: &Path) -> Result<(), StoreError> {
        let (path, temporary) = (dir.join(FILE), dir.join("store.json.new"));
        let text = serde_json::to_vec_pretty(self).expect("a manifest is plain data");
        let write = || {
            let mut file = File::create(&temporary)?;
            file.write_all(&text)?;
            file.sync_all()?;
            fs::rename(&temporary, &path)?;
            File::open(dir)?.sync_all()
        };
        write().map_err(StoreError::io("write", &path))
    }
}
