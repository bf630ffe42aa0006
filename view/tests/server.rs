//! Who is answered and who is refused.

mod common;

use common::{Page, record};

#[test]
fn only_whoever_knows_the_address_and_comes_from_it_is_answered() {
    let file = record("two-merges", &["--set", "end.vehicles=8"]);
    let page = Page::of(&[file.path()]);
    let token = page.token();
    let own = format!("/{token}/api/status");
    let host = format!("127.0.0.1:{}", page.port());
    let ask = |path: &str, headers: &[(&str, &str)]| page.ask("GET", path, headers).0;
    assert_eq!(ask(&own, &[("Host", &host)]), 200);
    assert_eq!(ask(&own, &[("Host", &format!("localhost:{}", page.port()))]), 200);
    // Its own page says where it is from.
    assert_eq!(ask(&own, &[("Host", &host), ("Origin", &format!("http://{host}"))]), 200);
    assert_eq!(ask(&own, &[("Host", &host), ("Sec-Fetch-Site", "same-origin")]), 200);

    // A wrong token, a shorter one, none.
    let other: String = token.chars().map(|c| if c == '0' { '1' } else { '0' }).collect();
    for path in [format!("/{other}/"), format!("/{}/", &token[1..]), "/".to_owned(), "/api/status".to_owned()]
    {
        assert_eq!(ask(&path, &[("Host", &host)]), 403, "{path}");
    }
    // A name that somebody else lets point here.
    for name in ["evil.example", &format!("evil.example:{}", page.port()), "127.0.0.1", ""] {
        assert_eq!(ask(&own, &[("Host", name)]), 403, "Host: {name}");
    }
    // A page from elsewhere, also one from another port of this machine.
    for origin in ["http://evil.example", "http://127.0.0.1:1", "null", &format!("https://{host}")] {
        assert_eq!(ask(&own, &[("Host", &host), ("Origin", origin)]), 403, "Origin: {origin}");
    }
    assert_eq!(ask(&own, &[("Host", &host), ("Sec-Fetch-Site", "cross-site")]), 403);
    // The same for what changes something.
    let steer = format!("/{token}/api/steer");
    assert_eq!(page.ask("POST", &steer, &[("Host", &host), ("Origin", "http://evil.example")]).0, 403);
    assert_eq!(page.ask("POST", &format!("/{other}/api/steer"), &[("Host", &host)]).0, 403);
}

#[test]
fn nothing_comes_from_elsewhere_and_nothing_is_kept() {
    let file = record("two-merges", &["--set", "end.vehicles=2"]);
    let page = Page::of(&[file.path()]);
    let host = format!("127.0.0.1:{}", page.port());
    let (status, head, body) = page.ask("GET", &format!("/{}/", page.token()), &[("Host", &host)]);
    assert_eq!(status, 200);
    for line in [
        "content-security-policy: default-src 'none'",
        "referrer-policy: no-referrer",
        "cache-control: no-store",
    ] {
        assert!(head.contains(line), "{line} is missing in\n{head}");
    }
    for text in [&body, include_str!("../assets/view.js"), include_str!("../assets/view.css")] {
        assert!(!text.contains("://"), "an address of something elsewhere");
    }
}
