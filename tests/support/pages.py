"""HTML pages as tests read them."""

from html.parser import HTMLParser

HOSTILE = """</script><script>alert(1)</script><img src=x onerror=alert(2)>"&'{{7*7}}$\\frac{1}{2}$"""


class Page(HTMLParser):
    """Tags with their attributes, and the text."""

    def __init__(self, text):
        super().__init__()
        self.tags, self.words = [], []
        self.feed(text)

    def handle_starttag(self, tag, attrs):
        self.tags.append((tag, dict(attrs)))

    def handle_data(self, data):
        self.words.append(data)

    def all(self, tag):
        return [attributes for name, attributes in self.tags if name == tag]

    @property
    def text(self):
        return " ".join(" ".join(self.words).split())
