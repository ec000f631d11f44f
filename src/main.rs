//! The `shearq` command.

use std::process::ExitCode;

fn main() -> ExitCode {
    shearq::main()
}
