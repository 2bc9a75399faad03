//! `getup average`: one controller from several of one ancestor.

use std::path::PathBuf;

use anyhow::{Context, Result, ensure};
use getup_policy::{MeanError, Policy};

use crate::output::{check_place, is_same_file, say, write_file};

/// What an evaluation said of one of them it did not say of their mean.
const OF_ONE: &str = "evaluation_";
/// What their mean is played with, and they have to have in common; each with what holds where a model does not say.
const OF_ALL: [(&str, &str); 3] = [("beta", "not said"), ("character", "standard"), ("physics_hz", "200")];

/// Average the weights of models of one ancestor into one model.
///
/// Runs that went on from the same checkpoint, or one run at several times, each sway about what they have in common:
/// their mean is often better than each. Evaluate it; models of different ancestors average to nothing.
#[derive(clap::Args)]
pub(crate) struct Args {
    /// Two or more model files.
    #[arg(required = true, num_args = 2.., value_name = "MODEL")]
    models: Vec<PathBuf>,
    /// The file to write.
    #[arg(long, value_name = "FILE")]
    output: PathBuf,
}

pub(crate) fn run(arguments: Args) -> Result<()> {
    check_place(&arguments.output)?;
    let load = |path: &PathBuf| Policy::load(path).with_context(|| path.display().to_string());
    let policies: Vec<Policy> = arguments.models.iter().map(load).collect::<Result<_>>()?;
    let first = &policies[0].metadata;
    for (path, policy) in arguments.models.iter().zip(&policies) {
        for (key, unsaid) in OF_ALL {
            let own = policy.metadata.get(key).map_or(unsaid, String::as_str);
            let others = first.get(key).map_or(unsaid, String::as_str);
            ensure!(
                own == others,
                "{}: its {key} is {own}, and that of {} is {others}: average models of one {key}",
                path.display(),
                arguments.models[0].display()
            );
        }
    }
    let mut mean = Policy::mean(&policies).map_err(|error| match error {
        MeanError::Differs { index, .. } => {
            anyhow::Error::new(error).context(arguments.models[index].display().to_string())
        }
        MeanError::None => error.into(),
    })?;
    let common = |key: &str, value: &str| {
        policies.iter().all(|policy| policy.metadata.get(key).is_some_and(|own| own == value))
    };
    mean.metadata.retain(|key, value| !key.starts_with(OF_ONE) && common(key, value));
    mean.metadata.insert("average_of".into(), policies.len().to_string());
    let shown = arguments.output.display();
    let is_output = |model: &PathBuf| is_same_file(model, &arguments.output);
    ensure!(!arguments.models.iter().any(is_output), "--output {shown} is one of the models: name another");
    write_file(&arguments.output, mean.to_bytes())?;
    say!("The mean of {} models is in {shown}. Try it: getup evaluate {shown}", policies.len());
    Ok(())
}
