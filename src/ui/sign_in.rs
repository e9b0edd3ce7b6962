//! The form to sign in with a token.

use maud::html;

use super::frame::{Frame, Section};

/// What the form says.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct SignIn {
    /// Address to go to afterwards.
    pub to: String,
    /// Text that the form repeats.
    pub csrf: String,
    /// Why the last attempt was refused.
    pub refused: Option<String>,
}

/// The page.
pub fn page(of: &SignIn) -> String {
    let main = html! {
        h1 { "Sign in" }
        @if let Some(why) = &of.refused { div.refused role="alert" { p { (why) } } }
        form.fields method="post" action="/sign-in" {
            input type="hidden" name="csrf" value=(of.csrf);
            input type="hidden" name="to" value=(of.to);
            label { "Token"
                input type="password" name="token" required autocomplete="current-password" autofocus spellcheck="false";
                span.soft { "It begins with rigcast_ and is shown once, when it is made." }
            }
            div { button.main type="submit" { "Sign in" } }
        }
        p.soft {
            "A session ends when you sign out, after twelve hours without a request, when its token is revoked or expires, "
            "and when the service starts anew."
        }
        p.soft { "No token yet? An admin makes one on the page Tokens, or with " code { "rigcast token create" } "." }
    };
    frame("Sign in", &main)
}

/// The page after signing in in a second window.
pub fn done() -> String {
    frame(
        "Signed in",
        &html! {
            h1 { "Signed in" }
            p { "You can close this window and go on in the other one." }
            p { a.button href="/" { "To the rigs" } }
        },
    )
}

fn frame(title: &str, main: &maud::Markup) -> String {
    Frame {
        title,
        section: Section::Elsewhere,
        way: Vec::new(),
        visitor: None,
        class: "narrow",
        scripts: &[],
    }
    .page(main)
}
