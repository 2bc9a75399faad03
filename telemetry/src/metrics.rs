//! What every role's metrics have in common.
//!
//! Each role has a struct of its own metrics, made once from the process's [`Registry`]. Names begin with
//! `getup_<role>_` and end in their unit, or in `_total` where they only count up.

use prometheus::process_collector::ProcessCollector;
use prometheus::{IntGauge, Opts, Registry};

/// A registry whose metrics all carry the run's name as the label `run`, with those of the process itself: its memory,
/// its processor time, its open files.
///
/// # Panics
/// Never: the names are well-formed, and the registry is new.
pub fn registry(run: &str) -> Registry {
    let labels = [("run".to_owned(), run.to_owned())].into();
    let registry = Registry::new_custom(None, Some(labels)).expect("a label is well-formed");
    registry.register(Box::new(ProcessCollector::for_self())).expect("the registry is new");
    registry
}

/// Registers `getup_build_info{version,role}`, which is 1.
///
/// A process with several roles calls it once for each.
///
/// # Panics
/// When the registry has this role already.
pub fn build_info(registry: &Registry, role: &str) {
    let options = Opts::new("getup_build_info", "The version and role of this process; always 1.")
        .const_label("version", env!("CARGO_PKG_VERSION"))
        .const_label("role", role);
    let gauge = IntGauge::with_opts(options).expect("the name and labels are well-formed");
    gauge.set(1);
    registry.register(Box::new(gauge)).expect("a role names itself once");
}
