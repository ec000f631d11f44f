//! The modules of a crate as syntax trees, and the items that paths in them name.

use std::collections::BTreeMap;
use std::fs;
use std::path::{Path, PathBuf};

use syn::{Attribute, Item, ItemUse, UseTree, Visibility};

/// Folders with code.
pub const CODE: [&str; 5] = ["src", "crates", "scoring", "submissions", "python"];

/// Names from the root of a crate to a module; empty for the root.
pub type ModulePath = Vec<String>;

/// A module without its tests.
pub struct Module {
    pub items: Vec<Item>,
    imports: Vec<Import>,
}

/// One name, or all names, that a module imports.
pub struct Import {
    pub path: Vec<String>,
    /// The name in the importing module; none for `*`.
    pub name: Option<String>,
    pub public: bool,
}

/// What a path names.
#[derive(Debug, Clone, PartialEq)]
pub enum Target {
    Module(ModulePath),
    Item(ModulePath, String),
}

/// The modules of a crate.
pub struct Tree(pub BTreeMap<ModulePath, Module>);

impl Tree {
    /// Parses all files of a crate from its `src/lib.rs`.
    pub fn of(folder: &str) -> Self {
        let mut tree = Tree(BTreeMap::new());
        let source = Path::new(folder).join("src");
        let root = parsed(&source.join("lib.rs"));
        tree.add(Vec::new(), root.items, &source);
        tree
    }

    /// Adds a module, with those inside, whose files are in `folder`.
    fn add(&mut self, path: ModulePath, items: Vec<Item>, folder: &Path) {
        let items: Vec<Item> = items
            .into_iter()
            .filter(|i| !is_test(attributes(i)))
            .collect();
        for item in &items {
            let Item::Mod(module) = item else { continue };
            let name = module.ident.to_string();
            let inside = folder.join(&name);
            let items = match &module.content {
                Some((_, items)) => items.clone(),
                None => parsed(&file_of(folder, &name)).items,
            };
            self.add([&path[..], &[name]].concat(), items, &inside);
        }
        let uses = items.iter().filter_map(|item| match item {
            Item::Use(one) => Some(imports(one)),
            _ => None,
        });
        let imports = uses.flatten().collect();
        self.0.insert(path, Module { items, imports });
    }

    /// What a path in the source of `module` names, if it belongs to this crate.
    pub fn resolve(&self, module: &[String], path: &[String]) -> Option<Target> {
        self.resolve_within(module, path, 0)
    }

    fn resolve_within(&self, module: &[String], path: &[String], depth: usize) -> Option<Target> {
        // Imports of imports; deeper ones are circular.
        if depth > 8 {
            return None;
        }
        let (first, rest) = path.split_first()?;
        match first.as_str() {
            "crate" => self.descend(Vec::new(), rest, depth),
            "self" => self.descend(module.to_vec(), rest, depth),
            "super" => {
                let (_, parent) = module.split_last()?;
                let mut rest = rest;
                let mut parent = parent;
                while let Some(("super", more)) = rest.split_first().map(|(a, b)| (a.as_str(), b)) {
                    (_, parent) = parent.split_last()?;
                    rest = more;
                }
                self.descend(parent.to_vec(), rest, depth)
            }
            _ => self.descend(module.to_vec(), path, depth),
        }
    }

    /// Follows names from a module.
    fn descend(&self, module: ModulePath, names: &[String], depth: usize) -> Option<Target> {
        let Some((name, rest)) = names.split_first() else {
            return Some(Target::Module(module));
        };
        let found = self.0.get(&module)?;
        let inside = [&module[..], std::slice::from_ref(name)].concat();
        if self.0.contains_key(&inside) {
            return self.descend(inside, rest, depth);
        }
        if found
            .items
            .iter()
            .any(|item| name_of(item).as_ref() == Some(name))
        {
            return Some(Target::Item(module, name.clone()));
        }
        for import in &found.imports {
            let followed = match &import.name {
                Some(own) if own == name => [&import.path[..], rest].concat(),
                Some(_) => continue,
                None => [&import.path[..], names].concat(),
            };
            // `use name::…` of another crate with the name of the import itself.
            if import.path.first() == Some(name) && import.path.len() == 1 {
                continue;
            }
            if let Some(target) = self.resolve_within(&module, &followed, depth + 1) {
                return Some(target);
            }
        }
        None
    }

    /// The imports of a module.
    pub fn imports(&self, module: &ModulePath) -> &[Import] {
        &self.0[module].imports
    }
}

/// All Rust files below the folders, with their paths.
pub fn files(folders: &[&str]) -> Vec<PathBuf> {
    let mut found = Vec::new();
    let mut folders: Vec<PathBuf> = folders.iter().map(PathBuf::from).collect();
    while let Some(folder) = folders.pop() {
        for entry in fs::read_dir(&folder).unwrap() {
            let path = entry.unwrap().path();
            if path.is_dir() {
                folders.push(path);
            } else if path.extension().is_some_and(|ending| ending == "rs") {
                found.push(path);
            }
        }
    }
    found.sort();
    found
}

fn parsed(path: &Path) -> syn::File {
    let text = fs::read_to_string(path).unwrap_or_else(|e| panic!("{}: {e}", path.display()));
    syn::parse_file(&text).unwrap_or_else(|e| panic!("{}: {e}", path.display()))
}

fn file_of(folder: &Path, name: &str) -> PathBuf {
    let file = folder.join(format!("{name}.rs"));
    if file.is_file() {
        return file;
    }
    folder.join(name).join("mod.rs")
}

/// Whether an item is compiled only for tests.
pub fn is_test(attributes: &[Attribute]) -> bool {
    attributes.iter().any(|attribute| {
        attribute.path().is_ident("cfg")
            && attribute
                .parse_args::<syn::Path>()
                .is_ok_and(|condition| condition.is_ident("test"))
    })
}

/// The attributes of an item.
pub fn attributes(item: &Item) -> &[Attribute] {
    match item {
        Item::Const(item) => &item.attrs,
        Item::Enum(item) => &item.attrs,
        Item::Fn(item) => &item.attrs,
        Item::Impl(item) => &item.attrs,
        Item::Macro(item) => &item.attrs,
        Item::Mod(item) => &item.attrs,
        Item::Static(item) => &item.attrs,
        Item::Struct(item) => &item.attrs,
        Item::Trait(item) => &item.attrs,
        Item::Type(item) => &item.attrs,
        Item::Use(item) => &item.attrs,
        _ => &[],
    }
}

/// The name of an item that has one, modules apart.
pub fn name_of(item: &Item) -> Option<String> {
    let name = match item {
        Item::Const(item) => &item.ident,
        Item::Enum(item) => &item.ident,
        Item::Fn(item) => &item.sig.ident,
        Item::Static(item) => &item.ident,
        Item::Struct(item) => &item.ident,
        Item::Trait(item) => &item.ident,
        Item::Type(item) => &item.ident,
        _ => return None,
    };
    Some(name.to_string())
}

/// The names of a path.
pub fn names(path: &syn::Path) -> Vec<String> {
    path.segments
        .iter()
        .map(|part| part.ident.to_string())
        .collect()
}

/// The single imports of a `use`.
fn imports(item: &ItemUse) -> Vec<Import> {
    fn flatten(tree: &UseTree, before: &[String], public: bool, out: &mut Vec<Import>) {
        let with = |name: &syn::Ident| [before, &[name.to_string()]].concat();
        let (path, name) = match tree {
            UseTree::Path(path) => return flatten(&path.tree, &with(&path.ident), public, out),
            UseTree::Group(group) => {
                for tree in &group.items {
                    flatten(tree, before, public, out);
                }
                return;
            }
            UseTree::Name(name) if name.ident == "self" => {
                (before.to_vec(), before.last().cloned())
            }
            UseTree::Name(name) => (with(&name.ident), Some(name.ident.to_string())),
            UseTree::Rename(rename) => (with(&rename.ident), Some(rename.rename.to_string())),
            UseTree::Glob(_) => (before.to_vec(), None),
        };
        out.push(Import { path, name, public });
    }
    let mut out = Vec::new();
    let public = matches!(item.vis, Visibility::Public(_));
    flatten(&item.tree, &[], public, &mut out);
    out
}

/// Makes the root of the repository the current folder, to which all paths are relative.
pub fn enter_root() {
    std::env::set_current_dir(concat!(env!("CARGO_MANIFEST_DIR"), "/../..")).unwrap();
}
