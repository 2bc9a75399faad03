//! What a segment file is made of: a header, and then records.
//!
//! | header | bytes | | record | bytes |
//! | --- | ---: | --- | --- | ---: |
//! | `getupseg` | 8 | | `F5` `SEG` | 4 |
//! | format | 4 | | length of the body | 4 |
//! | CRC-32 of what follows | 4 | | the segment's number in the log | 8 |
//! | [`State`] before the file's first segment | 40 | | CRC-32 of length, number and body | 4 |
//! | | | | the segment's message | |
//!
//! All numbers are little-endian. Each file says by itself where in the log it belongs, and each record where it
//! begins and whether it is whole: a file that was cut or scribbled over still gives up every whole segment.

use bytes::Bytes;
use getup_proto::{RunSpec, Segment, v1};
use prost::Message;
use std::ops::Range;

/// The format of the files.
const FORMAT: u32 = 1;
const FILE_MAGIC: [u8; 8] = *b"getupseg";
const RECORD_MAGIC: [u8; 4] = [0xf5, b'S', b'E', b'G'];
/// Before the first record.
pub(crate) const HEADER_BYTES: usize = 16 + State::BYTES;
/// Before a record's body.
const FRAME_BYTES: usize = 20;

/// Totals over the store's life.
#[derive(Clone, Copy, PartialEq, Eq, Debug, Default)]
pub(crate) struct State {
    /// Segments ever appended; also the number of the next one.
    pub(crate) segments: u64,
    pub(crate) env_steps: u64,
    pub(crate) transitions: u64,
    pub(crate) episodes: u64,
    /// Number of the oldest segment that is still kept.
    pub(crate) oldest: u64,
}

/// How far a writer's segments are durable.
#[derive(Clone, Copy, PartialEq, Eq, Debug)]
pub(crate) struct Mark {
    /// The greatest sequence number that is.
    pub(crate) sequence: u64,
    /// Number in the log of the writer's newest segment.
    pub(crate) segment: u64,
}

impl State {
    const BYTES: usize = 40;

    /// Counts a segment that was appended.
    pub(crate) fn add(&mut self, segment: &Segment) {
        self.segments += 1;
        self.env_steps += u64::from(segment.env_steps);
        self.transitions += segment.steps as u64;
        self.episodes += u64::from(segment.end.is_some());
    }

    /// The greater of each total.
    pub(crate) fn max(self, other: Self) -> Self {
        Self {
            segments: self.segments.max(other.segments),
            env_steps: self.env_steps.max(other.env_steps),
            transitions: self.transitions.max(other.transitions),
            episodes: self.episodes.max(other.episodes),
            oldest: self.oldest.max(other.oldest),
        }
    }

    pub(crate) fn encode(self) -> Vec<u8> {
        numbers_to_bytes([self.segments, self.env_steps, self.transitions, self.episodes, self.oldest])
    }

    pub(crate) fn decode(payload: &[u8]) -> Option<Self> {
        let [segments, env_steps, transitions, episodes, oldest] = numbers_from_bytes(payload)?;
        Some(Self { segments, env_steps, transitions, episodes, oldest })
    }
}

impl Mark {
    pub(crate) fn encode(self) -> Vec<u8> {
        numbers_to_bytes([self.sequence, self.segment])
    }

    pub(crate) fn decode(payload: &[u8]) -> Option<Self> {
        let [sequence, segment] = numbers_from_bytes(payload)?;
        Some(Self { sequence, segment })
    }
}

/// Begins a file whose first segment comes after `before`.
pub(crate) fn put_header(buffer: &mut Vec<u8>, before: State) {
    let state = before.encode();
    buffer.extend(FILE_MAGIC);
    buffer.extend(FORMAT.to_le_bytes());
    buffer.extend(crc32fast::hash(&state).to_le_bytes());
    buffer.extend(state);
}

/// Adds a segment, as the log's `number`th.
pub(crate) fn put_segment(buffer: &mut Vec<u8>, number: u64, segment: &Segment) {
    let message = segment.to_wire();
    let length = message.encoded_len();
    buffer.reserve(FRAME_BYTES + length);
    let frame = buffer.len();
    buffer.extend(RECORD_MAGIC);
    // A message is far under 4 GB: see `MAX_MESSAGE_BYTES`.
    buffer.extend((length as u32).to_le_bytes());
    buffer.extend(number.to_le_bytes());
    buffer.extend([0; 4]);
    let body = buffer.len();
    message.encode(buffer).expect("a vector grows");
    let crc = checksum(&buffer[frame + 4..frame + 16], &buffer[body..]);
    buffer[frame + 16..body].copy_from_slice(&crc.to_le_bytes());
}

/// The totals that a file's header gives; None if it is not whole.
pub(crate) fn header(file: &[u8]) -> Option<State> {
    let (magic, rest) = file.split_first_chunk::<8>()?;
    let (format, rest) = rest.split_first_chunk::<4>()?;
    let (crc, rest) = rest.split_first_chunk::<4>()?;
    let (state, _) = rest.split_first_chunk::<{ State::BYTES }>()?;
    let whole = *magic == FILE_MAGIC
        && u32::from_le_bytes(*format) == FORMAT
        && u32::from_le_bytes(*crc) == crc32fast::hash(state);
    whole.then(|| State::decode(state)).flatten()
}

/// The records of a file.
#[derive(Clone, Debug)]
pub(crate) struct Records {
    file: Bytes,
    at: usize,
}

/// A record that is whole.
#[derive(Clone, PartialEq, Eq, Debug)]
pub(crate) struct Record {
    /// Of the segment, in the log.
    pub(crate) number: u64,
    /// The segment's message.
    body: Bytes,
}

/// Bytes of a file that are no whole record, up to the next one that is, or to the file's end.
#[derive(Clone, PartialEq, Eq, Debug)]
pub(crate) struct Torn {
    pub(crate) bytes: Range<usize>,
}

impl Records {
    /// Those of a file's content, behind its header.
    pub(crate) fn new(file: Bytes) -> Self {
        let at = HEADER_BYTES.min(file.len());
        Self { file, at }
    }

    /// Where the next one begins.
    pub(crate) fn position(&self) -> usize {
        self.at
    }

    /// The record at `at`, and where it ends.
    fn record(&self, at: usize) -> Option<(Record, usize)> {
        let (frame, rest) = self.file.get(at..)?.split_first_chunk::<FRAME_BYTES>()?;
        let (magic, fields) = frame.split_first_chunk::<4>()?;
        let (length, fields) = fields.split_first_chunk::<4>()?;
        let (number, fields) = fields.split_first_chunk::<8>()?;
        let length = u32::from_le_bytes(*length) as usize;
        let body = rest.get(..length)?;
        let whole = *magic == RECORD_MAGIC && *fields == checksum(&frame[4..16], body).to_le_bytes();
        let body = at + FRAME_BYTES..at + FRAME_BYTES + length;
        let end = body.end;
        whole.then(|| (Record { number: u64::from_le_bytes(*number), body: self.file.slice(body) }, end))
    }

    /// Where the next whole record begins, from `at` on; the file's length if there is none.
    fn next_whole(&self, at: usize) -> usize {
        let windows = self.file.get(at..).unwrap_or_default().windows(RECORD_MAGIC.len());
        let begins = windows.enumerate().filter(|(_, window)| *window == RECORD_MAGIC);
        let mut places = begins.map(|(place, _)| at + place);
        places.find(|&place| self.record(place).is_some()).unwrap_or(self.file.len())
    }
}

impl Iterator for Records {
    type Item = Result<Record, Torn>;

    fn next(&mut self) -> Option<Self::Item> {
        if self.at >= self.file.len() {
            return None;
        }
        if let Some((record, end)) = self.record(self.at) {
            self.at = end;
            return Some(Ok(record));
        }
        let from = self.at;
        self.at = self.next_whole(from + 1);
        Some(Err(Torn { bytes: from..self.at }))
    }
}

impl Record {
    /// The segment, checked as if it had just come in.
    pub(crate) fn segment(&self, spec: &RunSpec) -> Result<Segment, String> {
        let wire = v1::Segment::decode(self.body.clone()).map_err(|error| error.to_string())?;
        Segment::parse(wire, spec).map_err(|error| error.to_string())
    }
}

fn checksum(head: &[u8], body: &[u8]) -> u32 {
    let mut hasher = crc32fast::Hasher::new();
    hasher.update(head);
    hasher.update(body);
    hasher.finalize()
}

fn numbers_to_bytes<const N: usize>(numbers: [u64; N]) -> Vec<u8> {
    numbers.iter().flat_map(|number| number.to_le_bytes()).collect()
}

fn numbers_from_bytes<const N: usize>(bytes: &[u8]) -> Option<[u64; N]> {
    let (numbers, rest) = bytes.as_chunks::<8>();
    let numbers: [[u8; 8]; N] = numbers.try_into().ok()?;
    rest.is_empty().then(|| numbers.map(u64::from_le_bytes))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::fixtures;
    use proptest::prelude::*;

    fn file(spec: &RunSpec, segments: u64) -> (Vec<u8>, Vec<usize>) {
        let mut file = Vec::new();
        put_header(&mut file, State::default());
        let mut begins = Vec::new();
        for number in 0..segments {
            begins.push(file.len());
            put_segment(&mut file, number, &fixtures::segment(spec, 1, number + 1, 1 + number as usize % 8));
        }
        begins.push(file.len());
        (file, begins)
    }

    #[test]
    fn a_whole_file_gives_its_header_and_every_segment() {
        let spec = fixtures::spec(8);
        let before = State { segments: 7, env_steps: 40, transitions: 50, episodes: 3, oldest: 2 };
        let mut bytes = Vec::new();
        put_header(&mut bytes, before);
        assert_eq!((header(&bytes), bytes.len()), (Some(before), HEADER_BYTES));
        let segments: Vec<Segment> = (1..=9).map(|i| fixtures::segment(&spec, 3, i, 8)).collect();
        for (number, segment) in (7..).zip(&segments) {
            put_segment(&mut bytes, number, segment);
        }
        let read: Vec<Record> = Records::new(bytes.into()).map(Result::unwrap).collect();
        assert_eq!(read.iter().map(|record| record.number).collect::<Vec<_>>(), (7..16).collect::<Vec<_>>());
        let parsed: Vec<Segment> = read.iter().map(|record| record.segment(&spec).unwrap()).collect();
        assert_eq!(parsed, segments);
    }

    proptest! {
        #[test]
        fn totals_and_marks_survive(numbers: [u64; 5]) {
            let [segments, env_steps, transitions, episodes, oldest] = numbers;
            let state = State { segments, env_steps, transitions, episodes, oldest };
            prop_assert_eq!(State::decode(&state.encode()), Some(state));
            let mark = Mark { sequence: segments, segment: env_steps };
            prop_assert_eq!(Mark::decode(&mark.encode()), Some(mark));
        }

        #[test]
        fn damage_costs_the_segments_it_touches_and_no_other(
            place: prop::sample::Index,
            length in 1usize..400,
            flip in 1u8..,
        ) {
            let (mut bytes, begins) = file(&fixtures::spec(8), 12);
            let from = HEADER_BYTES + place.index(bytes.len() - HEADER_BYTES);
            let to = (from + length).min(bytes.len());
            bytes[from..to].iter_mut().for_each(|byte| *byte ^= flip);
            let records: Vec<_> = Records::new(bytes.into()).collect();
            let whole: Vec<u64> = records.iter().flatten().map(|record| record.number).collect();
            let untouched = |number: &u64| {
                let record = begins[*number as usize]..begins[*number as usize + 1];
                record.end <= from || record.start >= to
            };
            prop_assert_eq!(whole, (0..12).filter(untouched).collect::<Vec<_>>());
            // What is torn is named, and lies where the damage is.
            let torn: Vec<&Torn> = records.iter().filter_map(|record| record.as_ref().err()).collect();
            prop_assert!(torn.iter().any(|torn| torn.bytes.start <= from && torn.bytes.end >= to), "{:?}", torn);
        }

        #[test]
        fn a_file_cut_anywhere_gives_what_lies_before_the_cut(place: prop::sample::Index) {
            let (bytes, begins) = file(&fixtures::spec(8), 12);
            let cut = place.index(bytes.len());
            let records = Records::new(Bytes::from(bytes).slice(..cut));
            let whole = records.flatten().count();
            prop_assert_eq!(whole, begins[1..].iter().filter(|&&end| end <= cut).count());
        }

        #[test]
        fn arbitrary_bytes_are_no_segments_and_no_panic(bytes in prop::collection::vec(any::<u8>(), 0..2000)) {
            prop_assert_eq!(header(&bytes), None);
            prop_assert_eq!(Records::new(bytes.into()).flatten().count(), 0);
        }
    }
}
