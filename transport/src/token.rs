//! Tokens: secrets that whoever calls has to know.

use std::fmt::{self, Write};

use subtle::ConstantTimeEq;
use tonic::metadata::{Ascii, MetadataValue};

use crate::SecurityError;
use crate::reload::File;

/// Shorter ones could be guessed.
const SHORTEST: usize = 16;

/// A new token: 256 random bits, as 64 hexadecimal digits.
pub fn generate_token() -> String {
    rand::random::<[u8; 32]>().iter().fold(String::new(), |mut token, byte| {
        write!(token, "{byte:02x}").expect("a string takes what is written");
        token
    })
}

/// The token that an `authorization` header carries, if any.
pub(crate) fn presented(header: &[u8]) -> Option<&[u8]> {
    let (scheme, token) = header.split_at_checked("Bearer ".len())?;
    scheme.eq_ignore_ascii_case(b"Bearer ").then(|| token.trim_ascii())
}

fn same(token: &[u8], expected: &[u8]) -> bool {
    token.ct_eq(expected).into()
}

/// The tokens of a file, at least one.
pub(crate) struct Tokens {
    /// Those that are accepted.
    accepted: Vec<String>,
    /// The first of them, as a client sends it.
    header: MetadataValue<Ascii>,
}

impl Tokens {
    /// Reads a token a line; empty lines are none.
    pub(crate) fn parse(files: &[File]) -> Result<Self, SecurityError> {
        let file = &files[0];
        let text = std::str::from_utf8(&file.bytes).map_err(|_| file.malformed("is not a text"))?;
        let accepted: Vec<String> =
            text.lines().map(str::trim).filter(|line| !line.is_empty()).map(str::to_owned).collect();
        let Some(first) = accepted.first() else {
            return Err(file.malformed("holds no token: `getup certs --token` makes one"));
        };
        let weak = |token: &String| token.len() < SHORTEST || !token.bytes().all(|b| b.is_ascii_graphic());
        if let Some(line) = accepted.iter().position(weak) {
            return Err(file.malformed(format!(
                "has a token (number {}) that is not {SHORTEST} visible ASCII characters or more: \
                 `getup certs --token` makes one",
                line + 1
            )));
        }
        let mut header: MetadataValue<Ascii> =
            format!("Bearer {first}").parse().expect("visible characters can stand in a header");
        header.set_sensitive(true);
        Ok(Self { accepted, header })
    }

    /// Whether one of the tokens is this one; all are compared, in a time that does not tell which.
    pub(crate) fn accept(&self, token: &[u8]) -> bool {
        self.accepted.iter().fold(false, |known, expected| known | same(token, expected.as_bytes()))
    }

    pub(crate) fn header(&self) -> MetadataValue<Ascii> {
        self.header.clone()
    }
}

impl fmt::Debug for Tokens {
    fn fmt(&self, formatter: &mut fmt::Formatter<'_>) -> fmt::Result {
        formatter.write_str("Tokens(…)")
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn tokens(text: &str) -> Result<Tokens, SecurityError> {
        Tokens::parse(&[File { setting: "token_file", path: "token".into(), bytes: text.into() }])
    }

    #[test]
    fn a_new_token_is_good_enough_and_never_the_same() {
        let token = generate_token();
        assert!(token.len() == 64 && tokens(&token).is_ok());
        assert_ne!(token, generate_token());
    }

    #[test]
    fn the_first_token_of_a_file_is_sent_and_each_is_accepted() {
        let tokens = tokens("\n  the-new-one-of-the-two\nthe-old-one-of-the-two  \n\n").unwrap();
        assert_eq!(tokens.header(), "Bearer the-new-one-of-the-two");
        assert!(tokens.accept(b"the-new-one-of-the-two") && tokens.accept(b"the-old-one-of-the-two"));
        assert!(!tokens.accept(b"") && !tokens.accept(b"the-new-one-of-the-tw"));
        assert_eq!(format!("{tokens:?} {:?}", tokens.header()), "Tokens(…) Sensitive");
    }

    #[test]
    fn a_file_without_a_good_token_is_refused_and_not_shown() {
        for text in ["", "\n \n", "too-short", "sixteen-or-more-\nshort", "with a space in the middle"] {
            let error = tokens(text).unwrap_err().to_string();
            assert!(error.starts_with("security.token_file = \"token\" h"), "{error}");
            assert!(error.contains("getup certs --token") && !error.contains("short"), "{error}");
        }
    }

    #[test]
    fn a_token_is_presented_as_a_bearer_token_alone() {
        assert_eq!(presented(b"Bearer secret"), Some(&b"secret"[..]));
        assert_eq!(presented(b"bearer  secret"), Some(&b"secret"[..]));
        assert_eq!(presented(b"Bearer "), Some(&b""[..]));
        assert!(presented(b"secret").is_none() && presented(b"Bearer").is_none());
        assert!(presented(b"Basic secret").is_none());
    }
}
