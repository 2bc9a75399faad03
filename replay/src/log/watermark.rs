//! `watermark`: how far the log was acknowledged, beside the log.
//!
//! A file that ends early looks like one that was written so. So before an acknowledgement leaves, the number of
//! segments it covers is written here; a log that holds fewer at start-up has lost some. The file also counts the
//! sampled transitions, which no commit carries. Each write is a few bytes into the kernel's page cache: cheap
//! enough for every commit and every minibatch, and whole when the process is killed.

use crate::error::StoreError;
use std::fs::{File, OpenOptions};
use std::io;
use std::os::unix::fs::FileExt;
use std::path::{Path, PathBuf};
use std::sync::{Mutex, PoisonError};

pub(super) const FILE: &str = "watermark";
/// A number and its CRC-32.
const RECORD_BYTES: usize = 12;
/// Places of the records, each in a disk sector of its own.
const ACKNOWLEDGED_AT: u64 = 0;
const SAMPLED_AT: u64 = 4096;

/// The open file.
#[derive(Debug)]
pub(crate) struct Watermark {
    file: File,
    path: PathBuf,
    /// The most transitions that were noted as sampled since it was opened.
    sampled: Mutex<u64>,
}

impl Watermark {
    /// Of a new store, durable on the disk: so many segments acknowledged, so many transitions sampled.
    pub(crate) fn create(dir: &Path, acknowledged: u64, sampled: u64) -> Result<Self, StoreError> {
        let path = dir.join(FILE);
        let options = OpenOptions::new().read(true).write(true).create(true).truncate(true).clone();
        let file = options.open(&path).map_err(StoreError::io("create", &path))?;
        let watermark = Self { file, path, sampled: Mutex::default() };
        watermark.write(ACKNOWLEDGED_AT, acknowledged)?;
        watermark.write(SAMPLED_AT, sampled)?;
        watermark.file.sync_all().map_err(StoreError::io("write", &watermark.path))?;
        Ok(watermark)
    }

    /// Of an existing store.
    pub(crate) fn open(dir: &Path) -> Result<Self, StoreError> {
        Self::open_with(dir, OpenOptions::new().read(true).write(true))
    }

    /// Of an existing store, which may be on a disk that cannot be written.
    pub(crate) fn open_to_read(dir: &Path) -> Result<Self, StoreError> {
        Self::open_with(dir, OpenOptions::new().read(true))
    }

    fn open_with(dir: &Path, options: &OpenOptions) -> Result<Self, StoreError> {
        let path = dir.join(FILE);
        match options.open(&path) {
            Ok(file) => Ok(Self { file, path, sampled: Mutex::default() }),
            Err(error) if error.kind() == io::ErrorKind::NotFound => {
                Err(StoreError::damaged(dir, format!("its file `{FILE}` is missing")))
            }
            Err(error) => Err(StoreError::io("open", path)(error)),
        }
    }

    /// Segments that were acknowledged.
    pub(crate) fn acknowledged(&self) -> Result<u64, StoreError> {
        self.read(ACKNOWLEDGED_AT)
    }

    /// Transitions that were sampled.
    pub(crate) fn sampled(&self) -> Result<u64, StoreError> {
        self.read(SAMPLED_AT)
    }

    /// To be called when `segments` are durable, before they are acknowledged.
    pub(crate) fn set_acknowledged(&self, segments: u64) -> Result<(), StoreError> {
        self.write(ACKNOWLEDGED_AT, segments)
    }

    /// To be called with the new total before sampled transitions are handed out. Of several that come at once the greatest
    /// stays.
    pub(crate) fn raise_sampled(&self, transitions: u64) -> Result<(), StoreError> {
        let mut noted = self.sampled.lock().unwrap_or_else(PoisonError::into_inner);
        if *noted < transitions {
            self.write(SAMPLED_AT, transitions)?;
            *noted = transitions;
        }
        Ok(())
    }

    fn write(&self, at: u64, number: u64) -> Result<(), StoreError> {
        let mut record = [0; RECORD_BYTES];
        let number = number.to_le_bytes();
        record[..8].copy_from_slice(&number);
        record[8..].copy_from_slice(&crc32fast::hash(&number).to_le_bytes());
        self.file.write_all_at(&record, at).map_err(StoreError::io("write", &self.path))
    }

    fn read(&self, at: u64) -> Result<u64, StoreError> {
        let mut record = [0; RECORD_BYTES];
        let whole = self.file.read_exact_at(&mut record, at).is_ok();
        if let ([number @ .., a, b, c, d], true) = (record, whole)
            && crc32fast::hash(&number) == u32::from_le_bytes([a, b, c, d])
        {
            return Ok(u64::from_le_bytes(number));
        }
        let dir = self.path.parent().unwrap_or(&self.path);
        Err(StoreError::damaged(dir, format!("its file `{FILE}` cannot be read")))
    }
}
