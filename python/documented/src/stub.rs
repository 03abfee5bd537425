//! Docstrings of a stub, read line by line.

use std::collections::HashMap;

/// Docstrings by dotted name, and the bases of each class. The module itself has the name `_core`.
#[derive(Default)]
pub(crate) struct Stub {
    texts: HashMap<String, String>,
    bases: HashMap<String, Vec<String>>,
}

impl Stub {
    /// Read the text of a stub: formatted, with `"""` around each docstring.
    pub(crate) fn parse(source: &str) -> Self {
        let mut stub = Self::default();
        let mut class = String::new();
        // Name that a docstring on the next line describes.
        let mut subject = Some("_core".to_owned());
        let mut lines = source.lines();
        while let Some(line) = lines.next() {
            let code = line.trim_start();
            if let Some(head) = line.strip_prefix("class ") {
                let (name, bases) =
                    head.trim_end_matches(':').split_once('(').unwrap_or((head.trim_end_matches(':'), ""));
                let bases = bases.trim_end_matches(')').split(", ").filter(|base| !base.is_empty());
                stub.bases.insert(name.to_owned(), bases.map(str::to_owned).collect());
                name.clone_into(&mut class);
                subject = Some(class.clone());
            } else if let Some(head) = code.strip_prefix("def ") {
                let name = head.split('(').next().unwrap_or(head);
                subject = Some(if line == code { name.to_owned() } else { format!("{class}.{name}") });
                let mut end = line;
                while !end.ends_with(':') && !end.ends_with(": ...") {
                    let Some(next) = lines.next() else { return stub };
                    end = next;
                }
            } else if let Some(first) = code.strip_prefix("\"\"\"") {
                let text = docstring(first, &line[..line.len() - code.len()], &mut lines);
                if let Some(subject) = subject.take() {
                    stub.texts.insert(subject, text);
                }
            } else if !code.is_empty() {
                // A docstring after a constant or an import describes that.
                subject = None;
            }
        }
        stub
    }

    /// Docstring of a class, a function or the module.
    pub(crate) fn top(&self, name: &str) -> Option<&str> {
        self.texts.get(name).map(String::as_str)
    }

    /// Docstring of a method or property of a class or of its bases.
    pub(crate) fn member(&self, class: &str, name: &str) -> Option<&str> {
        self.top(&format!("{class}.{name}"))
            .or_else(|| self.bases.get(class)?.iter().find_map(|base| self.member(base, name)))
    }
}

/// Rest of a docstring after its opening quotes, without the indentation of the lines after the first.
fn docstring<'a>(first: &str, indent: &str, rest: &mut impl Iterator<Item = &'a str>) -> String {
    let mut text = String::new();
    let mut line = first;
    loop {
        if let Some(end) = line.strip_suffix("\"\"\"") {
            text.push_str(end);
            return text.trim_end().to_owned();
        }
        text.push_str(line);
        text.push('\n');
        let Some(next) = rest.next() else { return text };
        line = next.strip_prefix(indent).unwrap_or(next.trim_start());
    }
}

#[cfg(test)]
mod tests {
    use super::Stub;

    const SOURCE: &str = r#""""The module.

More.
"""

COUNT: int
"""A constant."""

class _Base:
    """A base."""

    @property
    def size(self) -> int:
        """Size in m."""

class Wall(_Base):
    """A wall.

    Args:
        at: Place in m.
    """

    LIMIT: int
    """Not a method."""

    def __new__(
        cls,
        at: float = 0.0,
    ) -> Wall: ...
    @overload
    def run(self, at: int) -> int: ...
    @overload
    def run(self, at: float) -> float:
        """Run."""

def top(
    at: float,
) -> float:
    """Return it."""
"#;

    #[test]
    fn each_docstring_has_the_name_of_what_it_describes() {
        let stub = Stub::parse(SOURCE);
        assert_eq!(stub.top("_core"), Some("The module.\n\nMore."));
        assert_eq!(stub.top("Wall"), Some("A wall.\n\nArgs:\n    at: Place in m."));
        assert_eq!(stub.member("Wall", "run"), Some("Run."));
        assert_eq!(stub.top("top"), Some("Return it."));
        assert_eq!(stub.texts.len(), 6);
    }

    #[test]
    fn a_member_of_a_base_is_one_of_the_class() {
        let stub = Stub::parse(SOURCE);
        assert_eq!(stub.member("Wall", "size"), Some("Size in m."));
        assert_eq!(stub.member("Wall", "width"), None);
    }

    #[test]
    fn a_constant_takes_its_own_docstring() {
        let stub = Stub::parse(SOURCE);
        assert_eq!(stub.member("Wall", "__new__"), None);
        assert_eq!(stub.top("COUNT"), None);
    }
}
