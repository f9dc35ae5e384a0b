// Hold fingers on the plate for a second and print what they feel, which the layout decides.
//
//   node examples/javascript/button.mjs 0.22,0.16 0.08,0.06      # metres from the south-west corner
//
// The daemon must be ready (`era status`); ERA_HAPTICS_SOCKET names its socket if it is no usual one.

import { EraClient } from "./era_client.mjs";

const places = process.argv.slice(2).map((text) => text.split(",").map(Number));
if (!places.length || !places.every((place) => place.length === 2 && place.every(Number.isFinite))) {
  console.error("usage: node button.mjs X,Y [X,Y ...]");
  process.exit(2);
}

const era = await EraClient.connect().catch(fail);
era.on("lost", fail);
process.on("SIGINT", () => era.stop().then(() => process.exit(130), fail));

const played = new Promise((resolve) => era.on("pattern", resolve));
const seconds = (count) => new Promise((resolve) => setTimeout(resolve, 1000 * count).unref());
await era.subscribe("pattern");
await era.arm().catch(fail);
await era.touch(places);
const pattern = await Promise.race([played, seconds(5)]);
if (pattern) {
  const { contacts, predicted_contrast_db: contrast } = pattern;
  console.log(`ERAs ${Object.keys(pattern.drive).sort().join(", ")}`);
  if (contrast !== null) console.log(`felt contrast ${contrast.toFixed(1)} dB`);
  else if (contacts.length === 1) console.log("one finger");
  else for (const { id, feels, level_db_sl } of contacts) console.log(`finger ${id}: ${feels}, ${level_db_sl?.toFixed(1)} dB SL`);
  await seconds(1);
} else {
  const { silence_reason, cause } = await era.status();
  console.log(`silent: ${silence_reason ?? cause}`);
  process.exitCode = 1;
}
await era.touch([]);
await era.disarm();
era.close();

function fail(error) {
  console.error(error.message);
  process.exit(1);
}
