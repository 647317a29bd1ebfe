/* Lets the search work from disk, where browsers refuse to start a worker: its script
   runs in a hidden frame instead. */
if (location.protocol === "file:") {
  window.Worker = class extends EventTarget {
    #scope;
    #ready;

    constructor(url) {
      super();
      const frame = document.createElement("iframe");
      frame.hidden = true;
      document.body.append(frame);
      const scope = this.#scope = frame.contentWindow;
      scope.postMessage = (data) =>
        this.dispatchEvent(new MessageEvent("message", { data }));
      const load = (source) => new Promise((done, failed) => {
        const script = scope.document.createElement("script");
        Object.assign(script, { src: source, onload: done, onerror: failed });
        scope.document.body.append(script);
      });
      scope.importScripts = (...sources) => sources.reduce(
        (before, source) => before.then(() => load(source)), Promise.resolve());
      this.#ready = load(url);
    }

    async postMessage(data) {
      await this.#ready;
      this.#scope.dispatchEvent(new MessageEvent("message", { data }));
    }
  };
}
