//! The public API of each crate, compared with `docs/api`.
//!
//! The listing shows what other crates can name, as declarations without bodies, comments and private fields.
//! Items that a macro of the crate declares are shown as the call of the macro.

use std::collections::BTreeSet;
use std::fs;
use std::path::Path;

use quote::ToTokens;
use syn::{
    Attribute, Block, Fields, ImplItem, Item, ItemImpl, Token, TraitItem, Type, Visibility,
    parse_quote,
};

use crate::tree::{LIBRARIES, ModulePath, Target, Tree, is_public, is_test, name_of, names};

/// Set this environment variable to store the present API.
const ACCEPT: &str = "SHEARQ_ACCEPT";

#[test]
fn public_items_are_those_that_are_listed() {
    crate::tree::enter_root();
    let mut changed = Vec::new();
    for (name, folder) in LIBRARIES {
        let path = Path::new("docs/api").join(format!("{name}.txt"));
        let found = listing(folder);
        if std::env::var_os(ACCEPT).is_some() {
            fs::create_dir_all("docs/api").unwrap();
            fs::write(&path, &found).unwrap();
        }
        let stored = fs::read_to_string(&path).unwrap_or_default();
        changed.extend(differences(&stored, &found).map(|line| format!("{name}: {line}")));
    }
    assert!(
        changed.is_empty(),
        "the public API is not the one listed in docs/api:\n{}\nTry: {ACCEPT}=1 cargo test --manifest-path tests/source/Cargo.toml api",
        changed.join("\n")
    );
}

/// Lines that only one of the texts has, and whether the texts differ in order alone.
fn differences<'a>(stored: &'a str, found: &'a str) -> impl Iterator<Item = String> + 'a {
    let lines = |text: &'a str| text.lines().collect::<BTreeSet<_>>();
    let (old, new) = (lines(stored), lines(found));
    let gone = old.difference(&new).map(|line| format!("- {line}"));
    let come = new.difference(&old).map(|line| format!("+ {line}"));
    let mut all: Vec<String> = gone.chain(come).collect();
    if all.is_empty() && stored != found {
        all.push("the order of lines differs".to_owned());
    }
    all.into_iter()
}

/// The public items of a crate as Rust declarations.
pub fn listing(folder: &str) -> String {
    let tree = Tree::of(folder);
    let mut public = BTreeSet::new();
    public_modules(&tree, &Vec::new(), &mut public);
    let lister = Lister { tree, public };
    let file = syn::File {
        shebang: None,
        attrs: Vec::new(),
        items: lister.module(&Vec::new()),
    };
    shortened(&prettyplease::unparse(&file))
}

/// Modules that other crates can name by their place in the tree.
fn public_modules(tree: &Tree, module: &ModulePath, found: &mut BTreeSet<ModulePath>) {
    found.insert(module.clone());
    for item in &tree.0[module].items {
        if let Item::Mod(inside) = item
            && is_public(item)
        {
            public_modules(tree, &child(module, &inside.ident), found);
        }
    }
}

fn child(module: &ModulePath, name: &syn::Ident) -> ModulePath {
    [&module[..], &[name.to_string()]].concat()
}

/// Stands for the body of a function.
const BODY: &str = "__body";
/// Stands for private fields.
const PRIVATE: &str = "__private";

/// Replaces the stand-ins.
fn shortened(text: &str) -> String {
    let mut lines: Vec<String> = Vec::new();
    let mut source = text.lines();
    while let Some(line) = source.next() {
        if line.trim() == BODY {
            // The brace before and the one after.
            let _ = source.next();
            let open = lines.pop().unwrap();
            let open = open.strip_suffix('{').unwrap().trim_end();
            let open = open.strip_suffix(',').unwrap_or(open);
            match (open.trim().is_empty(), lines.last_mut()) {
                (true, Some(before)) => before.push(';'),
                _ => lines.push(format!("{open};")),
            }
        } else if line.trim().starts_with(PRIVATE) {
            let indent = line.len() - line.trim_start().len();
            lines.push(format!("{:indent$}// private fields", ""));
        } else {
            lines.push(line.replace(&format!("{PRIVATE}!()"), "_"));
        }
    }
    lines.join("\n") + "\n"
}

struct Lister {
    tree: Tree,
    /// Modules that other crates can name.
    public: BTreeSet<ModulePath>,
}

impl Lister {
    /// The public items of a module, by name.
    fn module(&self, module: &ModulePath) -> Vec<Item> {
        let mut found: Vec<(String, Vec<Item>)> = Vec::new();
        for item in &self.tree.0[module].items {
            match (item, name_of(item)) {
                (Item::Mod(inside), _) if is_public(item) => {
                    let name = inside.ident.to_string();
                    found.push((name, vec![self.submodule(&child(module, &inside.ident))]));
                }
                (_, Some(name)) if is_public(item) => {
                    found.push((name.clone(), self.declared(module, &name)));
                }
                (Item::Macro(call), None) if call.ident.is_none() => {
                    found.push((
                        call.mac.path.to_token_stream().to_string(),
                        vec![bare_macro(call)],
                    ));
                }
                _ => {}
            }
        }
        for import in self
            .tree
            .imports(module)
            .iter()
            .filter(|import| import.public)
        {
            let name = import.name.clone().unwrap_or_else(|| "*".to_owned());
            found.push((
                name,
                self.exported(module, &import.path, import.name.as_deref()),
            ));
        }
        found.sort_by(|a, b| a.0.cmp(&b.0));
        found.into_iter().flat_map(|(_, items)| items).collect()
    }

    fn submodule(&self, module: &ModulePath) -> Item {
        let name = syn::Ident::new(module.last().unwrap(), proc_macro2::Span::call_site());
        let items = self.module(module);
        Item::Mod(parse_quote!(pub mod #name { #(#items)* }))
    }

    /// What a `pub use` makes public: the declarations, or the `use` if they are listed elsewhere.
    fn exported(&self, module: &ModulePath, path: &[String], name: Option<&str>) -> Vec<Item> {
        let target = self.tree.resolve(module, path);
        match (target, name) {
            (Some(Target::Item(home, own)), Some(name))
                if own == name && !self.public.contains(&home) =>
            {
                self.declared(&home, &own)
            }
            (Some(Target::Module(home)), None) if !self.public.contains(&home) => {
                self.module(&home)
            }
            (Some(Target::Module(home)), Some(_)) if !self.public.contains(&home) => {
                vec![self.submodule(&home)]
            }
            (target, _) => {
                // From a macro of the module: its call shows the declaration.
                let calls = match target {
                    None => self.macros(module, path),
                    Some(_) => Vec::new(),
                };
                let path = match name {
                    Some(name) if path.last().is_none_or(|last| last != name) => {
                        format!("{} as {name}", path.join("::"))
                    }
                    Some(_) => path.join("::"),
                    None => format!("{}::*", path.join("::")),
                };
                let path: syn::UseTree = syn::parse_str(&path).unwrap();
                let mut items = vec![Item::Use(parse_quote!(pub use #path;))];
                items.extend(calls);
                items
            }
        }
    }

    /// The calls of macros in the module of a path that declare the path's last name.
    fn macros(&self, module: &ModulePath, path: &[String]) -> Vec<Item> {
        let Some((name, home)) = path.split_last() else {
            return Vec::new();
        };
        let Some(Target::Module(home)) = self.tree.resolve(module, home) else {
            return Vec::new();
        };
        let macros = |defined: bool| {
            let items = self.tree.0[&home].items.iter();
            items.filter_map(move |item| match item {
                Item::Macro(item) if item.ident.is_some() == defined => Some(item),
                _ => None,
            })
        };
        // The name is in the call, or in the macro that is called.
        let declares = |call: &syn::ItemMacro| {
            let arguments = without_docs(call.mac.tokens.clone());
            let first = arguments.into_iter().next();
            first.is_some_and(|token| token.to_string() == *name)
                || macros(true).any(|definition| {
                    definition.ident.as_ref() == call.mac.path.get_ident()
                        && definition
                            .mac
                            .tokens
                            .to_string()
                            .contains(&format!("struct {name} "))
                })
        };
        let calls = macros(false).filter(|call| declares(call));
        calls.map(bare_macro).collect()
    }

    /// An item with its implementations.
    fn declared(&self, module: &ModulePath, name: &str) -> Vec<Item> {
        let item = self.tree.item(module, name).unwrap();
        let mut items = vec![bare(item.clone())];
        let this = Target::Item(module.clone(), name.to_owned());
        let mut blocks = Vec::new();
        for (place, content) in &self.tree.0 {
            for item in &content.items {
                if let Item::Impl(block) = item
                    && self.is_of(place, block, &this)
                    && let Some(block) = bare_impl(block)
                {
                    blocks.push(block);
                }
            }
        }
        blocks.sort_by_key(|block| block.to_token_stream().to_string());
        items.extend(blocks.into_iter().map(Item::Impl));
        items
    }

    /// Whether an implementation is of a type, or of a trait for a type of another crate.
    fn is_of(&self, place: &ModulePath, block: &ItemImpl, this: &Target) -> bool {
        let resolved = |path: &syn::Path| self.tree.resolve(place, &names(path));
        let mut of = block.self_ty.as_ref();
        while let Type::Reference(reference) = of {
            of = &reference.elem;
        }
        let of = match of {
            Type::Path(of) => resolved(&of.path),
            _ => None,
        };
        match (of, &block.trait_) {
            (Some(of), _) => of == *this,
            (None, Some((_, path, _))) => resolved(path).as_ref() == Some(this),
            (None, None) => false,
        }
    }
}

/// Keeps the attributes that users of an item notice.
fn kept(attributes: &mut Vec<Attribute>) {
    attributes.retain(|attribute| {
        [
            "cfg_attr",
            "derive",
            "non_exhaustive",
            "must_use",
            "repr",
            "cfg",
            "deprecated",
        ]
        .iter()
        .any(|name| attribute.path().is_ident(name))
    });
}

/// A declaration without comments, bodies and private fields.
fn bare(mut item: Item) -> Item {
    match &mut item {
        Item::Const(item) => kept(&mut item.attrs),
        Item::Static(item) => kept(&mut item.attrs),
        Item::Type(item) => kept(&mut item.attrs),
        Item::Fn(item) => {
            kept(&mut item.attrs);
            *item.block = body();
        }
        Item::Struct(item) => {
            kept(&mut item.attrs);
            bare_fields(&mut item.fields, true);
        }
        Item::Enum(item) => {
            kept(&mut item.attrs);
            for variant in &mut item.variants {
                kept(&mut variant.attrs);
                bare_fields(&mut variant.fields, false);
            }
        }
        Item::Trait(item) => {
            kept(&mut item.attrs);
            for inside in &mut item.items {
                bare_trait_item(inside);
            }
        }
        _ => {}
    }
    item
}

fn body() -> Block {
    let body = syn::Ident::new(BODY, proc_macro2::Span::call_site());
    parse_quote!({ #body })
}

fn bare_trait_item(item: &mut TraitItem) {
    match item {
        TraitItem::Fn(function) => {
            kept(&mut function.attrs);
            if function.default.is_some() {
                function.default = Some(parse_quote!({}));
            }
        }
        TraitItem::Const(item) => kept(&mut item.attrs),
        TraitItem::Type(item) => kept(&mut item.attrs),
        _ => {}
    }
}

/// Replaces the private fields of a structure by a stand-in.
fn bare_fields(fields: &mut Fields, of_structure: bool) {
    let is_shown = |field: &syn::Field| !of_structure || matches!(field.vis, Visibility::Public(_));
    let all = fields.iter().all(is_shown);
    match fields {
        Fields::Named(named) => {
            let shown = named.named.iter().filter(|field| is_shown(field)).cloned();
            let mut shown: syn::punctuated::Punctuated<_, Token![,]> = shown.collect();
            if !all {
                let private = syn::Ident::new(PRIVATE, proc_macro2::Span::call_site());
                shown.push(parse_quote_field(&private));
            }
            named.named = shown;
        }
        Fields::Unnamed(unnamed) => {
            let private = syn::Ident::new(PRIVATE, proc_macro2::Span::call_site());
            for field in &mut unnamed.unnamed {
                if !is_shown(field) {
                    field.ty = parse_quote!(#private!());
                }
            }
        }
        Fields::Unit => {}
    }
    for field in fields.iter_mut() {
        kept(&mut field.attrs);
    }
}

fn parse_quote_field(name: &syn::Ident) -> syn::Field {
    syn::Field {
        attrs: Vec::new(),
        vis: Visibility::Inherited,
        mutability: syn::FieldMutability::None,
        ident: Some(name.clone()),
        colon_token: Some(Token![:](proc_macro2::Span::call_site())),
        ty: parse_quote!(()),
    }
}

/// The public part of an implementation, if there is any.
fn bare_impl(block: &ItemImpl) -> Option<ItemImpl> {
    let mut block = block.clone();
    kept(&mut block.attrs);
    let is_trait = block.trait_.is_some();
    block.items.retain(|item| match item {
        ImplItem::Fn(item) if is_test(&item.attrs) => false,
        ImplItem::Fn(item) => !is_trait && matches!(item.vis, Visibility::Public(_)),
        ImplItem::Const(item) => !is_trait && matches!(item.vis, Visibility::Public(_)),
        ImplItem::Type(_) => true,
        _ => false,
    });
    for item in &mut block.items {
        match item {
            ImplItem::Fn(item) => {
                kept(&mut item.attrs);
                item.block = body();
            }
            ImplItem::Const(item) => kept(&mut item.attrs),
            ImplItem::Type(item) => kept(&mut item.attrs),
            _ => {}
        }
    }
    (is_trait || !block.items.is_empty()).then_some(block)
}

/// The call of a macro without its comments.
fn bare_macro(call: &syn::ItemMacro) -> Item {
    let mut call = call.clone();
    kept(&mut call.attrs);
    call.mac.tokens = without_docs(call.mac.tokens);
    Item::Macro(call)
}

fn without_docs(tokens: proc_macro2::TokenStream) -> proc_macro2::TokenStream {
    use proc_macro2::{Group, TokenStream, TokenTree};
    let mut kept: Vec<TokenTree> = Vec::new();
    for token in tokens {
        if let TokenTree::Group(group) = &token {
            let is_doc = group
                .stream()
                .into_iter()
                .next()
                .is_some_and(|t| t.to_string() == "doc");
            if is_doc && kept.last().is_some_and(|t| t.to_string() == "#") {
                kept.pop();
                continue;
            }
            let inner = without_docs(group.stream());
            kept.push(TokenTree::Group(Group::new(group.delimiter(), inner)));
            continue;
        }
        kept.push(token);
    }
    kept.into_iter().collect::<TokenStream>()
}

#[test]
fn a_listing_shows_public_items_alone() {
    crate::tree::enter_root();
    let folder = tempfile::tempdir().unwrap();
    let source = folder.path().join("src");
    fs::create_dir(&source).unwrap();
    let root = "mod inner;\npub mod open;\npub use inner::Shown;\npub use other::Far;\n\
                pub fn first(x: f64) -> f64 { x }\nfn hidden() {}\npub(crate) fn near() {}\n\
                #[cfg(test)]\npub fn only_in_tests() {}\n";
    let inner = "/// A comment.\n#[derive(Clone)]\npub struct Shown { pub a: u8, b: u8 }\n\
                 impl Shown { pub fn new() -> Self { todo!() } fn secret(&self) {} }\n\
                 impl Drop for Shown { fn drop(&mut self) {} }\npub struct Unreachable;\n";
    fs::write(source.join("lib.rs"), root).unwrap();
    fs::write(source.join("inner.rs"), inner).unwrap();
    fs::write(source.join("open.rs"), "pub const LIMIT: u8 = 3;\n").unwrap();
    let expected = "pub use other::Far;\n#[derive(Clone)]\npub struct Shown {\n    pub a: u8,\n    // private fields\n}\n\
                    impl Drop for Shown {}\nimpl Shown {\n    pub fn new() -> Self;\n}\n\
                    pub fn first(x: f64) -> f64;\npub mod open {\n    pub const LIMIT: u8 = 3;\n}\n";
    assert_eq!(listing(folder.path().to_str().unwrap()), expected);
}
