//! Reading a [`RolloutFile`], by hand: so that what is wrong with one is said with the rollout's index, the field,
//! what it holds and what it should hold, which a derived reader cannot.

use serde_json::{Map, Value};

use crate::character::Character;
use crate::error::SimError;
use crate::rollout::{Rollout, RolloutFile};

/// Why a file of rollouts cannot be played.
#[derive(Debug, thiserror::Error)]
pub enum RolloutError {
    /// The text is no JSON.
    #[error("not JSON: {0} (NaN and Infinity are no JSON numbers)")]
    Json(#[from] serde_json::Error),
    /// A field is absent or of the wrong kind. `path` is like `rollouts[2].actions[17][3]`.
    #[error("{path} is {got}; it must be {wanted}")]
    Field {
        /// Where.
        path: String,
        /// What is there.
        got: String,
        /// What must be.
        wanted: &'static str,
    },
    /// A vector of the wrong length for the character.
    #[error("rollouts[{rollout}].{field} has {got} numbers; the character needs {wanted}")]
    Length {
        /// Which rollout, from 0.
        rollout: usize,
        /// Which of its fields.
        field: String,
        /// Numbers given.
        got: usize,
        /// Numbers the character has.
        wanted: usize,
    },
    /// A number that is NaN, infinite or beyond what MuJoCo accepts.
    #[error(
        "rollouts[{rollout}].{field} is {got}; it must be finite (positions and velocities within ±1e10)"
    )]
    NotFinite {
        /// Which rollout, from 0.
        rollout: usize,
        /// Which number of it.
        field: String,
        /// The number.
        got: f64,
    },
    /// A control rate that is not the task's.
    #[error("control_hz is {got}; the get-up task is controlled at {wanted}")]
    ControlHz {
        /// The file's.
        got: u32,
        /// The task's.
        wanted: u32,
    },
    /// A setting of the file that the simulation refuses: `physics_hz` or `control_limit`.
    #[error(transparent)]
    Sim(#[from] SimError),
}

impl RolloutFile {
    /// Reads a file's text. Lengths are checked by [`replay`](crate::rollout::replay), which knows the character.
    ///
    /// # Errors
    /// [`RolloutError::Json`] or [`RolloutError::Field`].
    pub fn parse(text: &str) -> Result<RolloutFile, RolloutError> {
        let root: Value = serde_json::from_str(text)?;
        let file = Node { value: &root, path: String::new() }.object()?;
        let character = file.optional("variant").map(|name| variant(&name)).transpose()?;
        let rate = |key, absent| file.optional(key).map_or(Ok(absent), |rate| rate.rate());
        let rollouts = file.required("rollouts")?.list("a list of rollouts")?;
        Ok(RolloutFile {
            character: character.unwrap_or_default(),
            physics_hz: rate("physics_hz", 200)?,
            control_hz: rate("control_hz", 40)?,
            control_limit: file.optional("control_limit").map_or(Ok(1.0), |limit| limit.number())?,
            rollouts: rollouts.into_iter().map(rollout).collect::<Result<_, _>>()?,
        })
    }

    /// The file's text: JSON that [`parse`](RolloutFile::parse) reads back to the same bits.
    pub fn to_json(&self) -> String {
        serde_json::to_string(self).expect("strings, numbers and lists of them are always JSON")
    }
}

fn rollout(node: Node) -> Result<Rollout, RolloutError> {
    let rollout = node.object()?;
    let vector = |key| rollout.required(key)?.numbers();
    Ok(Rollout {
        beta: rollout.required("beta")?.number()?,
        qpos0: vector("qpos0")?,
        qvel0: vector("qvel0")?,
        actions: rollout
            .required("actions")?
            .list("a list of actions")?
            .into_iter()
            .map(|action| action.numbers())
            .collect::<Result<_, _>>()?,
        ..Rollout::default()
    })
}

fn variant(node: &Node) -> Result<Character, RolloutError> {
    match node.value.as_str() {
        Some("standard") => Ok(Character::Standard),
        Some("Disabled" | "cast") => Ok(Character::Cast),
        Some("Noarm" | "one_arm") => Ok(Character::OneArm),
        _ => Err(node.is_not("\"standard\", \"Disabled\" (cast) or \"Noarm\" (one_arm)")),
    }
}

/// A JSON value and where it is.
struct Node<'a> {
    value: &'a Value,
    path: String,
}

/// A JSON object and where it is.
struct Object<'a> {
    fields: &'a Map<String, Value>,
    path: String,
}

impl<'a> Node<'a> {
    fn is_not(&self, wanted: &'static str) -> RolloutError {
        let got = match self.value {
            Value::Array(items) => format!("a list of {}", items.len()),
            Value::Object(_) => "an object".to_owned(),
            scalar => scalar.to_string(),
        };
        let path = if self.path.is_empty() { "the file".to_owned() } else { self.path.clone() };
        RolloutError::Field { path, got, wanted }
    }

    fn object(self) -> Result<Object<'a>, RolloutError> {
        match self.value {
            Value::Object(fields) => Ok(Object { fields, path: self.path }),
            _ => Err(self.is_not("an object")),
        }
    }

    fn list(&self, wanted: &'static str) -> Result<Vec<Node<'a>>, RolloutError> {
        let items = self.value.as_array().ok_or_else(|| self.is_not(wanted))?;
        let items = items.iter().enumerate();
        Ok(items.map(|(index, value)| Node { value, path: format!("{}[{index}]", self.path) }).collect())
    }

    fn number(&self) -> Result<f64, RolloutError> {
        self.value.as_f64().ok_or_else(|| self.is_not("a finite number"))
    }

    fn numbers(&self) -> Result<Vec<f64>, RolloutError> {
        self.list("a list of numbers")?.iter().map(Node::number).collect()
    }

    fn rate(&self) -> Result<u32, RolloutError> {
        let rate = self.value.as_u64().and_then(|rate| u32::try_from(rate).ok());
        rate.ok_or_else(|| self.is_not("a whole number of steps a second"))
    }
}

impl<'a> Object<'a> {
    fn path_of(&self, key: &str) -> String {
        if self.path.is_empty() { key.to_owned() } else { format!("{}.{key}", self.path) }
    }

    fn optional(&self, key: &str) -> Option<Node<'a>> {
        self.fields.get(key).map(|value| Node { value, path: self.path_of(key) })
    }

    fn required(&self, key: &str) -> Result<Node<'a>, RolloutError> {
        self.optional(key).ok_or_else(|| RolloutError::Field {
            path: self.path_of(key),
            got: "absent".to_owned(),
            wanted: "given",
        })
    }
}
