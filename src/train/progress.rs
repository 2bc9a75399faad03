//! The progress display of `getup train`: a bar on a terminal, a log line now and then without one.

use std::io::IsTerminal;
use std::sync::Arc;
use std::time::{Duration, Instant};

use getup_learner::hub::{Hub, Standing};
use getup_telemetry::Waits;
use indicatif::{ProgressBar, ProgressDrawTarget, ProgressStyle};
use tokio::task::JoinHandle;
use tokio_util::sync::CancellationToken;

use crate::config::Config;
use crate::role::Role;

/// How often the bar is redrawn.
const REDRAW: Duration = Duration::from_millis(250);
/// How often a line is logged where there is no terminal.
const LINE: Duration = Duration::from_secs(15);
/// Waits shorter than this are the normal give and take.
const WAIT_SHOWN: f64 = 3.0;

/// The display, until it is finished.
pub(super) struct Progress {
    stop: CancellationToken,
    task: JoinHandle<()>,
}

impl Progress {
    /// Shows how training stands, from now on.
    pub(super) fn start(role: &Role, config: &Config, hub: Arc<Hub>) -> Self {
        let stop = CancellationToken::new();
        let display = Display {
            bar: std::io::stderr().is_terminal().then(|| role.progress.add(bar(config.steps))),
            uniform_steps: config.sac.uniform_steps,
            steps: config.steps,
            hub,
            waits: role.waits.clone(),
            first: None,
        };
        let task = tokio::spawn(display.run(stop.clone()));
        Self { stop, task }
    }

    /// Ends the display.
    pub(super) async fn finish(self) {
        self.stop.cancel();
        // The display holds nothing that its end could lose.
        let _ = self.task.await;
    }
}

struct Display {
    bar: Option<ProgressBar>,
    uniform_steps: u64,
    steps: u64,
    hub: Arc<Hub>,
    waits: Waits,
    /// When the first env steps were seen, and how many, for the rate.
    first: Option<(Instant, u64)>,
}

fn bar(steps: u64) -> ProgressBar {
    let (bar, template) = if steps > 0 {
        (ProgressBar::new(steps), "{bar:24} {pos}/{len} env steps, {elapsed}  {msg}")
    } else {
        (ProgressBar::no_length(), "{spinner} {pos} env steps, {elapsed}  {msg}")
    };
    bar.set_draw_target(ProgressDrawTarget::stderr());
    bar.with_style(ProgressStyle::with_template(template).expect("the template is constant and valid"))
}

impl Display {
    async fn run(mut self, stop: CancellationToken) {
        let pause = if self.bar.is_some() { REDRAW } else { LINE };
        loop {
            tokio::select! {
                () = stop.cancelled() => break,
                () = tokio::time::sleep(pause) => {}
            }
            let standing = self.hub.standing();
            let text = self.describe(&standing);
            match &self.bar {
                Some(bar) => {
                    bar.set_position(standing.env_steps);
                    bar.set_message(text);
                }
                None => tracing::info!(env_steps = standing.env_steps, "{text}"),
            }
        }
        if let Some(bar) = &self.bar {
            bar.finish_and_clear();
        }
    }

    fn describe(&mut self, standing: &Standing) -> String {
        let mut parts = vec![format!("{} updates", standing.updates)];
        match standing.state {
            // How far, its wait says.
            "filling" => {}
            _ if standing.updates == 0 => parts.push(format!("the first {} env steps", self.uniform_steps)),
            _ => self.describe_pace(standing, &mut parts),
        }
        if let Some(evaluation) = &standing.evaluation {
            let [rises, stands] = [evaluation.rises, evaluation.stands].map(|share| 100.0 * share);
            let (mean, min) = (evaluation.mean, evaluation.min);
            parts.push(format!(
                "last evaluation: mean {mean:.1}, min {min:.1}, rises {rises:.0} %, stands {stands:.0} %"
            ));
        }
        let waits = self.waits.current();
        if let Some(wait) = waits.iter().find(|wait| wait.seconds > WAIT_SHOWN) {
            parts.push(wait.to_string());
        }
        parts.join(" · ")
    }

    fn describe_pace(&mut self, standing: &Standing, parts: &mut Vec<String>) {
        let (since, from) = *self.first.get_or_insert((Instant::now(), standing.env_steps));
        let seconds = since.elapsed().as_secs_f64();
        let per_second = (standing.env_steps - from) as f64 / seconds.max(1e-9);
        parts.push(format!("{:.0} updates/s, {per_second:.0} env steps/s", standing.updates_per_second));
        parts.push(format!("stage {} β {:.2}", standing.stage, standing.beta));
        let left = self.steps.saturating_sub(standing.env_steps) as f64 / per_second;
        if self.steps > 0 && left.is_finite() {
            parts.push(format!("{} left", human(left)));
        }
    }
}

/// Minutes and seconds, or hours and minutes.
fn human(seconds: f64) -> String {
    let seconds = seconds as u64;
    match seconds {
        0..3600 => format!("{}:{:02} min", seconds / 60, seconds % 60),
        _ => format!("{}:{:02} h", seconds / 3600, seconds / 60 % 60),
    }
}
