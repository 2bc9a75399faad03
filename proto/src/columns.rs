//! The column codec: `f32` values as little-endian bytes.
//!
//! A column arrives inside a message, at any address, so its bytes need not be aligned for `f32`; everything
//! here works on plain bytes, and compiles to a copy where the machine is little-endian.

use bytes::Bytes;

/// Bytes of one value.
pub const VALUE_BYTES: usize = size_of::<f32>();

/// What the policy saw before each step, and after the last.
pub const OBSERVATION: &str = "observation";
/// What it did.
pub const ACTION: &str = "action";
/// What it got: one value a step. Sampling sums it over the n steps of a transition.
pub const REWARD: &str = "reward";
/// The torque limit β̂ of the episode.
pub const BETA: &str = "beta";

/// Of minibatches alone: γ^n, or 0 after a terminal state.
pub const DISCOUNT: &str = "discount";
/// Of minibatches alone: begins the name of the column that holds the row after the transition.
pub const NEXT_PREFIX: &str = "next_";

/// The little-endian bytes of `values`.
pub fn encode(values: &[f32]) -> Bytes {
    let mut bytes = vec![0; values.len() * VALUE_BYTES];
    for (bytes, value) in bytes.chunks_exact_mut(VALUE_BYTES).zip(values) {
        bytes.copy_from_slice(&value.to_le_bytes());
    }
    bytes.into()
}

/// The little-endian bytes of `values`, without a copy where the machine is little-endian.
pub fn into_bytes(values: Vec<f32>) -> Bytes {
    struct Values(Vec<f32>);
    impl AsRef<[u8]> for Values {
        fn as_ref(&self) -> &[u8] {
            bytemuck::cast_slice(&self.0)
        }
    }
    if cfg!(target_endian = "little") { Bytes::from_owner(Values(values)) } else { encode(&values) }
}

/// Writes the values of `bytes` over `values`.
///
/// # Panics
/// Unless `bytes` holds exactly `values.len()` values.
pub fn decode_into(bytes: &[u8], values: &mut [f32]) {
    assert_eq!(bytes.len(), values.len() * VALUE_BYTES, "a column's bytes must fill its values");
    for (value, decoded) in values.iter_mut().zip(iter(bytes)) {
        *value = decoded;
    }
}

/// The values of `bytes`; an incomplete one at the end is left out.
pub fn iter(bytes: &[u8]) -> impl ExactSizeIterator<Item = f32> + '_ {
    bytes.as_chunks::<VALUE_BYTES>().0.iter().map(|&value| f32::from_le_bytes(value))
}

/// Index of the first value that is NaN or infinite.
pub fn first_non_finite(bytes: &[u8]) -> Option<usize> {
    // One pass without a branch, which vectorises: nearly every column is finite.
    let all_finite = iter(bytes).fold(true, |all, value| all & value.is_finite());
    if all_finite { None } else { iter(bytes).position(|value| !value.is_finite()) }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    #[test]
    fn bytes_of_owned_values_are_the_same() {
        let values = vec![1.0, -2.5, f32::MIN_POSITIVE, 0.0];
        assert_eq!(into_bytes(values.clone()), encode(&values));
    }

    proptest! {
        #[test]
        fn every_bit_pattern_survives_the_codec_at_any_alignment(
            bits in prop::collection::vec(any::<u32>(), 0..200),
            offset in 0usize..8,
        ) {
            let values: Vec<f32> = bits.iter().map(|&bits| f32::from_bits(bits)).collect();
            let mut message = vec![0; offset];
            message.extend_from_slice(&encode(&values));
            let column = &Bytes::from(message)[offset..];
            let mut decoded = vec![0.0; values.len()];
            decode_into(column, &mut decoded);
            prop_assert_eq!(decoded.iter().map(|v| v.to_bits()).collect::<Vec<_>>(), bits.clone());
            prop_assert_eq!(iter(column).map(f32::to_bits).collect::<Vec<_>>(), bits);
        }

        #[test]
        fn the_first_non_finite_value_is_found(bits in prop::collection::vec(any::<u32>(), 0..200)) {
            let values: Vec<f32> = bits.iter().map(|&bits| f32::from_bits(bits)).collect();
            prop_assert_eq!(first_non_finite(&encode(&values)), values.iter().position(|v| !v.is_finite()));
        }
    }

    #[test]
    fn the_bytes_are_little_endian_on_every_machine() {
        assert_eq!(&encode(&[1.0, -2.0])[..], [0, 0, 0x80, 0x3f, 0, 0, 0, 0xc0]);
    }
}
