// The hub's stream of changes. It goes on by itself after a break, where it was.

import { put, reset } from "./store.js";

const SILENT_MS = 45_000; // the hub says something every 15 s
const AGAIN_MS = 5_000;

/** Follow the hub. told(state, reason): state is "open", "broken", or "refused" for a reason. */
export function follow(told) {
  let source = null;
  let heardAt = 0;

  const heard = () => {
    heardAt = Date.now();
  };

  function open() {
    heard();
    source = new EventSource("api/stream");
    source.onopen = () => {
      heard();
      told("open");
    };
    source.onmessage = (event) => {
      heard();
      const { key, value } = JSON.parse(event.data);
      put(key, value);
    };
    source.addEventListener("alive", heard);
    source.addEventListener("reset", () => {
      heard();
      reset();
    });
    source.onerror = () => {
      if (source.readyState === EventSource.CLOSED) refused();
      else told("broken");
    };
  }

  async function refused() {
    source.close();
    told("refused", await why());
    setTimeout(open, AGAIN_MS);
  }

  setInterval(() => {
    if (Date.now() - heardAt > SILENT_MS && source.readyState !== EventSource.CLOSED) {
      told("broken");
      source.close();
      open();
    }
  }, AGAIN_MS);
  open();
}

async function why() {
  try {
    const answer = await fetch("api/stream", { headers: { accept: "application/json" } });
    if (answer.ok) {
      await answer.body.cancel();
      return "";
    }
    return (await answer.json()).text;
  } catch {
    return "";
  }
}
