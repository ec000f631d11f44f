//! Options that have another name now.

use clap::error::{ContextKind, ContextValue, ErrorKind};

/// Old and new name of each option.
const OPTIONS: [(&str, &str); 1] = [("--figures", "--metrics")];

/// The error that names the new option, if the unknown option of `error` is an old one.
pub(crate) fn advice(error: &clap::Error) -> Option<String> {
    if error.kind() != ErrorKind::UnknownArgument {
        return None;
    }
    let Some(ContextValue::String(found)) = error.get(ContextKind::InvalidArg) else {
        return None;
    };
    let found = found.split('=').next().unwrap_or(found);
    let (old, new) = OPTIONS.iter().find(|(old, _)| *old == found)?;
    Some(format!(
        "the option has another name (found {old}, expected {new}). Try: {new}"
    ))
}

#[cfg(test)]
mod tests {
    use clap::{Arg, Command, CommandFactory};

    use super::*;
    use crate::Cli;

    #[test]
    fn an_old_option_names_the_new_one() {
        for line in ["score --figures q", "compare --figures=q,m_cross raw"] {
            let words = ["shearq"].into_iter().chain(line.split(' '));
            let error = Cli::command().try_get_matches_from(words).unwrap_err();
            let advice = advice(&error).unwrap_or_default();
            assert!(advice.ends_with("Try: --metrics"), "{line}: {advice}");
        }
        let error = Cli::command().try_get_matches_from(["shearq", "score", "--figure"]);
        assert_eq!(advice(&error.unwrap_err()), None);
    }

    #[test]
    fn new_options_exist_and_old_ones_do_not() {
        fn has(command: &Command, option: &str) -> bool {
            let named = |a: &Arg| {
                a.get_long()
                    .is_some_and(|name| option == format!("--{name}"))
            };
            command.get_arguments().any(named)
                || command.get_subcommands().any(|inner| has(inner, option))
        }
        let cli = Cli::command();
        for (old, new) in OPTIONS {
            assert!(has(&cli, new) && !has(&cli, old), "{old}: {new}");
        }
    }
}
