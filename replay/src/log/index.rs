//! What the segment files no longer say: [`Index`], over sled.
//!
//! | key | value |
//! | --- | --- |
//! | `o` | number of the oldest segment that is kept |
//! | `w`, writer | [`Mark`]: how far this writer's segments are durable |
//!
//! Files that are kept say all this themselves, so it is written only when one is about to be dropped: a few
//! thousand bytes for tens of megabytes of segments. Numbers are big-endian in keys and little-endian in values;
//! every value carries a CRC-32 over its key and itself.

use super::panics::caught;
use super::record::Mark;
use crate::config::SyncMode;
use crate::error::StoreError;
use std::fs::File;
use std::path::{Path, PathBuf};
use std::thread;
use std::time::{Duration, Instant};

/// sled's folder in the store's.
pub(crate) const FOLDER: &str = "index";
/// sled's page cache: the whole index of a large store is smaller.
const CACHE_BYTES: u64 = 4 << 20;
/// How long to wait for the lock of a store that was just closed in this process.
const LOCK_PATIENCE: Duration = Duration::from_secs(5);
const CRC_BYTES: usize = 4;
const OLDEST: &[u8] = b"o";
const WRITER: u8 = b'w';

/// The open index.
#[derive(Debug)]
pub(crate) struct Index {
    /// The store's folder.
    dir: PathBuf,
    sync: SyncMode,
    /// None after an error, which sticks to a sled that is open: the next write opens it again.
    db: Option<sled::Db>,
}

/// What it holds.
#[derive(Clone, PartialEq, Eq, Debug, Default)]
pub(crate) struct Content {
    /// Number of the oldest segment that is kept.
    pub(crate) oldest: u64,
    /// By writer.
    pub(crate) marks: Vec<(u64, Mark)>,
}

impl Index {
    /// Opens the index of the store in `dir`, or creates it, and reads it.
    pub(crate) fn open(dir: &Path, sync: SyncMode) -> Result<(Self, Content), StoreError> {
        let opened = caught(|| {
            let db = open(dir)?;
            let content = read(dir, &db)?;
            Ok((db, content))
        });
        let (db, content) = opened.unwrap_or_else(|panic| Err(inconsistent(dir, &panic)))?;
        Ok((Self { dir: dir.to_owned(), sync, db: Some(db) }, content))
    }

    /// Writes the content down, over what was there, durably: `forgotten` writers lose their mark.
    pub(crate) fn write(&mut self, content: &Content, forgotten: &[u64]) -> Result<(), StoreError> {
        let mut batch = sled::Batch::default();
        put(&mut batch, OLDEST.to_vec(), &content.oldest.to_le_bytes());
        for &(writer, mark) in &content.marks {
            put(&mut batch, writer_key(writer), &mark.encode());
        }
        for &writer in forgotten {
            batch.remove(writer_key(writer));
        }
        let written = caught(|| self.commit(batch));
        let written = written.unwrap_or_else(|panic| Err(inconsistent(&self.dir, &panic)));
        if written.is_err() {
            self.db = None;
        }
        written
    }

    fn commit(&mut self, batch: sled::Batch) -> Result<(), StoreError> {
        let db = match &self.db {
            Some(db) => db,
            None => self.db.insert(open(&self.dir)?),
        };
        db.apply_batch(batch).map_err(StoreError::sled(&self.dir))?;
        db.flush().map_err(StoreError::sled(&self.dir))?;
        if self.sync == SyncMode::Data {
            let path = self.dir.join(FOLDER).join("db");
            let synced = File::open(&path).and_then(|file| file.sync_data());
            synced.map_err(StoreError::io("sync", path))?;
        }
        Ok(())
    }
}

fn open(dir: &Path) -> Result<sled::Db, StoreError> {
    // Written as a whole and seldom: nothing to do in between.
    let config = sled::Config::new().path(dir.join(FOLDER)).cache_capacity(CACHE_BYTES).flush_every_ms(None);
    let give_up = Instant::now() + LOCK_PATIENCE;
    loop {
        match config.open() {
            // A store that this process closed keeps sled's lock until sled's threads have let go of it.
            Err(sled::Error::Io(error)) if error.to_string().contains("lock") && Instant::now() < give_up => {
                thread::sleep(Duration::from_millis(20));
            }
            result => return result.map_err(StoreError::sled(dir)),
        }
    }
}

fn read(dir: &Path, db: &sled::Db) -> Result<Content, StoreError> {
    let damaged = || StoreError::damaged(dir, "an entry of its index fails its checksum");
    let mut content = Content::default();
    for entry in db.iter() {
        let (key, value) = entry.map_err(StoreError::sled(dir))?;
        let payload = unseal(&key, &value).ok_or_else(damaged)?;
        match (&key[..], payload) {
            (OLDEST, payload) => {
                content.oldest = u64::from_le_bytes(payload.try_into().map_err(|_| damaged())?);
            }
            ([WRITER, writer @ ..], payload) => {
                let writer = writer.try_into().map_err(|_| damaged())?;
                let mark = Mark::decode(payload).ok_or_else(damaged)?;
                content.marks.push((u64::from_be_bytes(writer), mark));
            }
            _ => return Err(damaged()),
        }
    }
    Ok(content)
}

fn inconsistent(dir: &Path, panic: &str) -> StoreError {
    StoreError::damaged(dir, format!("its index is inconsistent ({panic})"))
}

fn writer_key(writer: u64) -> Vec<u8> {
    [&[WRITER], &writer.to_be_bytes()[..]].concat()
}

/// Adds `payload` to the batch under `key`, sealed.
fn put(batch: &mut sled::Batch, key: Vec<u8>, payload: &[u8]) {
    let value = [&checksum(&key, payload).to_le_bytes(), payload].concat();
    batch.insert(key, value);
}

/// What was sealed under `key`; None if either is damaged.
fn unseal<'a>(key: &[u8], value: &'a [u8]) -> Option<&'a [u8]> {
    let (crc, payload) = value.split_first_chunk::<CRC_BYTES>()?;
    (checksum(key, payload) == u32::from_le_bytes(*crc)).then_some(payload)
}

fn checksum(key: &[u8], payload: &[u8]) -> u32 {
    let mut hasher = crc32fast::Hasher::new();
    hasher.update(key);
    hasher.update(payload);
    hasher.finalize()
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;
    use tempfile::TempDir;

    #[test]
    fn what_was_written_is_there_when_it_is_opened_again() {
        let dir = TempDir::new().unwrap();
        let (mut index, empty) = Index::open(dir.path(), SyncMode::Data).unwrap();
        assert_eq!(empty, Content::default());
        let mark = |sequence| Mark { sequence, segment: sequence + 1 };
        index.write(&Content { oldest: 5, marks: vec![(1, mark(3)), (2, mark(4))] }, &[]).unwrap();
        index.write(&Content { oldest: 9, marks: vec![(u64::MAX, mark(8))] }, &[1]).unwrap();
        drop(index);
        let (_, content) = Index::open(dir.path(), SyncMode::Process).unwrap();
        assert_eq!(content, Content { oldest: 9, marks: vec![(2, mark(4)), (u64::MAX, mark(8))] });
    }

    proptest! {
        #[test]
        fn a_changed_byte_of_key_or_value_is_noticed(
            payload in prop::collection::vec(any::<u8>(), 0..64),
            place: prop::sample::Index,
            flip in 1u8..,
        ) {
            let key = writer_key(5);
            let mut value = checksum(&key, &payload).to_le_bytes().to_vec();
            value.extend(&payload);
            prop_assert_eq!(unseal(&key, &value), Some(&payload[..]));
            prop_assert_eq!(unseal(&writer_key(6), &value), None);
            let place = place.index(value.len());
            value[place] ^= flip;
            prop_assert_eq!(unseal(&key, &value), None);
        }
    }
}
