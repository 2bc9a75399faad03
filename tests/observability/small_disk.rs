//! A disk that is soon full.

use std::process::Command;

/// A disk of a few megabytes, where this process may mount one.
pub(crate) struct SmallDisk {
    pub(crate) folder: tempfile::TempDir,
}

impl SmallDisk {
    pub(crate) fn new(size: &str) -> Option<Self> {
        let disk = Self { folder: tempfile::tempdir().unwrap() };
        disk.mount(&format!("size={size}")).then_some(disk)
    }

    pub(crate) fn mount(&self, options: &str) -> bool {
        let mounting = Command::new("mount")
            .args(["-t", "tmpfs", "-o", options, "tmpfs"])
            .arg(self.folder.path())
            .output();
        mounting.is_ok_and(|output| output.status.success())
    }
}

impl Drop for SmallDisk {
    fn drop(&mut self) {
        // One that was not mounted is not.
        let _ = Command::new("umount").arg(self.folder.path()).output();
    }
}
