//! Modules of a crate do not import each other in circles. A module and the modules inside it count as one.

use std::collections::{BTreeMap, BTreeSet};

use syn::visit::{self, Visit};

use crate::crates::libraries;
use crate::tree::{ModulePath, Target, Tree, attributes, is_test, names};

/// Imports between the modules of a crate: what each one uses.
type Uses = BTreeMap<ModulePath, BTreeSet<ModulePath>>;

/// Collects the paths in a module's code.
struct Paths(Vec<Vec<String>>);

impl<'ast> Visit<'ast> for Paths {
    fn visit_path(&mut self, path: &'ast syn::Path) {
        // A single name is defined here or imported.
        if path.segments.len() > 1 {
            self.0.push(names(path));
        }
        visit::visit_path(self, path);
    }

    fn visit_item_mod(&mut self, _: &'ast syn::ItemMod) {
        // A module of its own.
    }

    fn visit_impl_item_fn(&mut self, function: &'ast syn::ImplItemFn) {
        if !is_test(&function.attrs) {
            visit::visit_impl_item_fn(self, function);
        }
    }
}

fn uses(tree: &Tree) -> Uses {
    let mut uses = Uses::new();
    for (module, content) in &tree.0 {
        let mut paths = Paths(Vec::new());
        for item in content
            .items
            .iter()
            .filter(|item| !is_test(attributes(item)))
        {
            paths.visit_item(item);
        }
        for import in tree.imports(module) {
            // A façade: it re-exports from the modules below it.
            let target = tree.resolve(module, &import.path);
            let below = |path: &ModulePath| path.starts_with(module);
            let is_below = match &target {
                Some(Target::Module(path) | Target::Item(path, _)) => below(path),
                None => true,
            };
            if !(import.public && is_below) {
                paths.0.push(import.path.clone());
            }
        }
        let used = uses.entry(module.clone()).or_default();
        for path in paths.0 {
            if let Some(Target::Item(other, _)) = tree.resolve(module, &path)
                && !other.starts_with(module)
                && !module.starts_with(&other)
            {
                used.insert(other);
            }
        }
    }
    uses
}

/// All modules that a module uses, directly or through others.
fn reached(uses: &Uses, from: &ModulePath) -> BTreeSet<ModulePath> {
    let mut found = BTreeSet::new();
    let mut next: Vec<&ModulePath> = uses[from].iter().collect();
    while let Some(module) = next.pop() {
        if found.insert(module.clone()) {
            next.extend(&uses[module]);
        }
    }
    found
}

#[test]
fn modules_do_not_import_each_other_in_circles() {
    crate::tree::enter_root();
    let mut circular = BTreeMap::new();
    for (name, folder) in libraries() {
        let tree = Tree::of(folder);
        let uses = uses(&tree);
        assert!(
            uses.len() == 1 || uses.values().any(|used| !used.is_empty()),
            "{name}"
        );
        let reached: BTreeMap<_, _> = uses.keys().map(|m| (m, reached(&uses, m))).collect();
        for (module, all) in &reached {
            if !all.contains(*module) {
                continue;
            }
            let back = uses[*module]
                .iter()
                .filter(|m| reached[m].contains(*module));
            let back: Vec<String> = back.map(|m| m.join("::")).collect();
            let full = [&[name.to_owned()][..], &module[..]].concat().join("::");
            circular.insert(full, back.join(", "));
        }
    }
    assert!(
        circular.is_empty(),
        "modules import modules that import them: {circular:#?}"
    );
}
