// The one WebSocket: comes back by itself, and tells the store whether it is there.

const RETRY_MS = 1000;

export class Socket {
  constructor(store, onFrame) {
    this.store = store;
    this.onFrame = onFrame;
    this.wanted = null;
    this.connect();
  }

  connect() {
    const scheme = location.protocol === "https:" ? "wss:" : "ws:";
    this.socket = new WebSocket(`${scheme}//${location.host}/watch`);
    this.socket.onopen = () => {
      this.store.socket = true;
      if (this.wanted) this.ask({ vehicle: this.wanted });
    };
    this.socket.onmessage = (event) => {
      this.store.receive(JSON.parse(event.data));
      this.onFrame();
    };
    this.socket.onclose = () => {
      this.store.socket = false;
      this.onFrame();
      setTimeout(() => this.connect(), RETRY_MS);
    };
  }

  ask(request) {
    if (this.socket.readyState === WebSocket.OPEN) this.socket.send(JSON.stringify(request));
  }

  lookAt(vehicle) {
    this.wanted = vehicle;
    this.ask({ vehicle });
  }
}

// The token stands behind the # of the address, which no browser sends to anybody.
const TOKEN = "fusiond-token";
export function token() {
  const found = /[#&]token=([^&]+)/.exec(location.hash);
  if (found) {
    sessionStorage.setItem(TOKEN, decodeURIComponent(found[1]));
    history.replaceState(null, "", location.pathname);
  }
  return sessionStorage.getItem(TOKEN);
}
