//! Docstrings of the extension: `#[documented]` copies them from the stub `_core.pyi`, so that they are written once.

use std::path::Path;

use proc_macro::TokenStream;
use proc_macro2::Span;
use quote::{ToTokens, quote};
use syn::{Attribute, Error, Ident, ImplItem, Item, LitStr, Type, parse_macro_input, parse_quote};

mod stub;

use stub::Stub;

/// Path of the stub in the crate of the extension.
const STUB: &str = "haptether/_core.pyi";

/// Give a class, its methods and fields, a function or the module the docstrings of the stub.
///
/// Stands above the attribute of `PyO3`. The name in Python is the argument, else that in Rust without the prefix `Py`.
/// A public function or method that the stub does not document is an error.
#[proc_macro_attribute]
pub fn documented(name: TokenStream, item: TokenStream) -> TokenStream {
    let name = parse_macro_input!(name as Option<Ident>).map(|name| name.to_string());
    let item = parse_macro_input!(item as Item);
    expand(name.as_deref(), item).unwrap_or_else(|error| error.to_compile_error()).into()
}

fn expand(name: Option<&str>, mut item: Item) -> Result<proc_macro2::TokenStream, Error> {
    let root = std::env::var("CARGO_MANIFEST_DIR").map_err(|error| unread(&error))?;
    let path = Path::new(&root).join(STUB);
    let stub = Stub::parse(&std::fs::read_to_string(&path).map_err(|error| unread(&error))?);
    let in_python = |ident: &Ident| {
        let ident = ident.to_string();
        name.unwrap_or_else(|| ident.strip_prefix("Py").unwrap_or(&ident)).to_owned()
    };
    match &mut item {
        Item::Struct(class) => {
            let owner = in_python(&class.ident);
            document(&mut class.attrs, required(&stub, &owner, class.ident.span())?)?;
            for field in &mut class.fields {
                if let Some(text) =
                    field.ident.as_ref().and_then(|ident| stub.member(&owner, &ident.to_string()))
                {
                    document(&mut field.attrs, text)?;
                }
            }
        }
        Item::Impl(methods) => {
            let owner = in_python(class_of(&methods.self_ty)?);
            for item in &mut methods.items {
                let ImplItem::Fn(method) = item else { continue };
                let ident = &method.sig.ident;
                let called = ident.to_string();
                if called.starts_with("__")
                    || method.attrs.iter().any(|attribute| attribute.path().is_ident("new"))
                {
                    continue;
                }
                let Some(text) = stub.member(&owner, &called) else {
                    return Err(missing(&format!("{owner}.{called}"), ident.span()));
                };
                document(&mut method.attrs, text)?;
            }
        }
        Item::Fn(function) => {
            let ident = &function.sig.ident;
            let text = required(&stub, &in_python(ident), ident.span())?;
            document(&mut function.attrs, text)?;
        }
        other => {
            return Err(Error::new_spanned(other, "a class, its methods or a function can be documented"));
        }
    }
    // The stub is an input of the build.
    let path = LitStr::new(&path.display().to_string(), Span::call_site());
    Ok(quote! { const _: &[u8] = include_bytes!(#path); #item })
}

fn class_of(of: &Type) -> Result<&Ident, Error> {
    match of {
        Type::Path(path) if path.path.segments.len() == 1 => Ok(&path.path.segments[0].ident),
        Type::Group(group) => class_of(&group.elem),
        other => Err(Error::new_spanned(other.to_token_stream(), "no class")),
    }
}

fn required<'a>(stub: &'a Stub, name: &str, span: Span) -> Result<&'a str, Error> {
    stub.top(name).ok_or_else(|| missing(name, span))
}

fn missing(name: &str, span: Span) -> Error {
    Error::new(span, format!("{STUB} has no docstring of `{name}`"))
}

fn unread(error: &dyn std::fmt::Display) -> Error {
    Error::new(Span::call_site(), format!("{STUB} cannot be read: {error}"))
}

/// Add the docstring; a doc comment beside it would show in `help()` as well.
fn document(attributes: &mut Vec<Attribute>, text: &str) -> Result<(), Error> {
    if let Some(own) = attributes.iter().find(|attribute| attribute.path().is_ident("doc")) {
        return Err(Error::new_spanned(own, format!("{STUB} documents this: use a plain comment")));
    }
    attributes.push(parse_quote!(#[doc = #text]));
    Ok(())
}
