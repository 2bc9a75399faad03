//! Keys and values of the log.
//!
//! | key | value |
//! | --- | --- |
//! | `n` | [`State`]: totals after the newest commit |
//! | `s`, segment, piece | a piece of the segment's message |
//! | `w`, writer | [`Mark`]: how far this writer's segments are durable |
//!
//! Numbers in keys are big-endian, so that keys sort as numbers do. Every value carries a CRC-32 over its key and
//! itself. A segment is stored as its message, cut into pieces that suit sled: a leaf of up to 16 of them stays
//! below the size at which sled would put it into a file of its own.

use getup_proto::{RunSpec, Segment, v1};
use prost::Message;

/// The longest piece of a segment's message.
pub(crate) const PIECE_BYTES: usize = 6_400;
const CRC_BYTES: usize = 4;

/// A key of the log.
#[derive(Clone, Copy, PartialEq, Eq, Debug)]
pub(crate) enum Key {
    State,
    Piece { segment: u64, piece: u16 },
    Writer(u64),
}

/// Totals over the store's life.
#[derive(Clone, Copy, PartialEq, Eq, Debug, Default)]
pub(crate) struct State {
    pub(crate) segments: u64,
    pub(crate) env_steps: u64,
    pub(crate) transitions: u64,
    pub(crate) episodes: u64,
    /// Number of the oldest segment that is still kept; older ones may be.
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

impl Key {
    pub(crate) fn encode(self) -> Vec<u8> {
        match self {
            Self::State => vec![b'n'],
            Self::Piece { segment, piece } => {
                let mut key = vec![b's'];
                key.extend(segment.to_be_bytes());
                key.extend(piece.to_be_bytes());
                key
            }
            Self::Writer(writer) => {
                let mut key = vec![b'w'];
                key.extend(writer.to_be_bytes());
                key
            }
        }
    }

    pub(crate) fn decode(key: &[u8]) -> Option<Self> {
        match *key {
            [b'n'] => Some(Self::State),
            [b's', ref segment @ .., a, b] => {
                let segment = u64::from_be_bytes(segment.try_into().ok()?);
                Some(Self::Piece { segment, piece: u16::from_be_bytes([a, b]) })
            }
            [b'w', ref writer @ ..] => Some(Self::Writer(u64::from_be_bytes(writer.try_into().ok()?))),
            _ => None,
        }
    }
}

impl State {
    /// Counts a segment that was appended.
    pub(crate) fn add(&mut self, segment: &Segment) {
        self.segments += 1;
        self.env_steps += u64::from(segment.env_steps);
        self.transitions += segment.steps as u64;
        self.episodes += u64::from(segment.end.is_some());
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

/// Adds `payload` to the batch under `key`, sealed.
pub(crate) fn put(batch: &mut sled::Batch, key: Key, payload: &[u8]) {
    let key = key.encode();
    let mut value = Vec::with_capacity(CRC_BYTES + payload.len());
    value.extend(checksum(&key, payload).to_le_bytes());
    value.extend_from_slice(payload);
    batch.insert(key, value);
}

/// Adds a segment to the batch, as the log's `number`th.
pub(crate) fn put_segment(batch: &mut sled::Batch, number: u64, segment: &Segment) {
    let message = segment.to_wire().encode_to_vec();
    for (piece, payload) in (0..).zip(message.chunks(PIECE_BYTES)) {
        put(batch, Key::Piece { segment: number, piece }, payload);
    }
}

/// What was sealed under `key`; None if either is damaged.
pub(crate) fn unseal<'a>(key: &[u8], value: &'a [u8]) -> Option<&'a [u8]> {
    let (crc, payload) = value.split_first_chunk::<CRC_BYTES>()?;
    (checksum(key, payload) == u32::from_le_bytes(*crc)).then_some(payload)
}

/// A segment from its joined pieces, checked as if it had just come in.
pub(crate) fn segment_from(message: Vec<u8>, spec: &RunSpec) -> Result<Segment, String> {
    let wire = v1::Segment::decode(bytes::Bytes::from(message)).map_err(|error| error.to_string())?;
    Segment::parse(wire, spec).map_err(|error| error.to_string())
}

fn checksum(key: &[u8], payload: &[u8]) -> u32 {
    let mut hasher = crc32fast::Hasher::new();
    hasher.update(key);
    hasher.update(payload);
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
    use proptest::prelude::*;

    proptest! {
        #[test]
        fn keys_survive_and_sort_as_their_numbers_do(a: (u64, u16), b: (u64, u16), writer: u64) {
            let key = |(segment, piece)| Key::Piece { segment, piece };
            for key in [key(a), Key::Writer(writer), Key::State] {
                prop_assert_eq!(Key::decode(&key.encode()), Some(key));
            }
            prop_assert_eq!(key(a).encode().cmp(&key(b).encode()), a.cmp(&b));
        }

        #[test]
        fn totals_and_marks_survive(numbers: [u64; 5]) {
            let [segments, env_steps, transitions, episodes, oldest] = numbers;
            let state = State { segments, env_steps, transitions, episodes, oldest };
            prop_assert_eq!(State::decode(&state.encode()), Some(state));
            let mark = Mark { sequence: segments, segment: env_steps };
            prop_assert_eq!(Mark::decode(&mark.encode()), Some(mark));
        }

        #[test]
        fn a_changed_byte_of_key_or_value_is_noticed(
            payload in prop::collection::vec(any::<u8>(), 0..64),
            place: prop::sample::Index,
            flip in 1u8..,
        ) {
            let key = Key::Writer(5).encode();
            let mut value = checksum(&key, &payload).to_le_bytes().to_vec();
            value.extend(&payload);
            prop_assert_eq!(unseal(&key, &value), Some(&payload[..]));
            prop_assert_eq!(unseal(&Key::Writer(6).encode(), &value), None);
            let place = place.index(value.len());
            value[place] ^= flip;
            prop_assert_eq!(unseal(&key, &value), None);
        }
    }
}
