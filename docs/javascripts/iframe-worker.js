// The search runs in a worker, which no browser starts from a file: there it runs in a hidden frame.
if (location.protocol === 'file:') {
  window.Worker = class extends EventTarget {
    constructor(url) {
      super();
      const frame = document.createElement('iframe');
      frame.hidden = true;
      document.body.append(frame);
      const worker = this.worker = frame.contentWindow;
      worker.document.open();
      worker.document.write('<!DOCTYPE html><head></head>');
      worker.document.close();
      worker.postMessage = (data) => this.dispatchEvent(new MessageEvent('message', {data}));
      worker.importScripts = (...urls) => urls.reduce((before, next) => before.then(() => load(next)),
        Promise.resolve());
      const load = (src) => new Promise((good, bad) => {
        const script = worker.document.createElement('script');
        Object.assign(script, {src, onload: good, onerror: bad});
        worker.document.head.append(script);
      });
      this.ready = load(url);
      this.addEventListener('message', (event) => this.onmessage?.(event));
    }
    postMessage(data) {
      this.ready.then(() => this.worker.dispatchEvent(new MessageEvent('message', {data})));
    }
    terminate() {}
  };
}
