// Read by MathJax when it starts. The font is the one that comes with it.
window.MathJax = {
  tex2jax: {
    inlineMath: [["\\(", "\\)"]],
    displayMath: [["$$", "$$"], ["\\[", "\\]"]],
  },
  "HTML-CSS": {
    availableFonts: [],
    webFont: "STIX-Web",
    imageFont: null,
    linebreaks: { automatic: true },
  },
  messageStyle: "none",
  showMathMenu: false,
};
