// Written by docs/generators/script_types.py.

/** Parameters and result of every method. */
export interface Methods {
  /** Introduce the client; returns the daemon's rig, table and layout. */
  hello: { params: HelloParams; result: HelloResult };
  /** Show the state of the daemon, the amplifiers and the contacts. */
  status: { params: Empty; result: StatusResult };
  /** Switch the high voltage on. Touches are felt until the lease expires. */
  arm: { params: ArmParams; result: ArmResult };
  /** Extend the lease. */
  renew: { params: RenewParams; result: RenewResult };
  /** Ramp to silence, then switch the high voltage off. Any client can disarm. While a link is lost, this stops all amplifiers. */
  disarm: { params: DisarmParams; result: Empty };
  /** Quick-stop all amplifiers. The stop is latched until `clear`. Not an emergency stop. Every client can stop the plate at any time. Fails with error 1006 if an amplifier is not confirmed silent. */
  stop: { params: RequestedBy; result: StopResult };
  /** Clear a stop, or a fault that no longer exists. The plate stays disarmed. */
  clear: { params: ClearParams; result: Empty };
  /** Report all fingers of a touch source. */
  touch: { params: TouchParams; result: Empty };
  /** Switch to another of the daemon's layouts. Continuous effects under resting fingers change immediately. Effects of limited duration, and effects that a program plays, continue to their end. */
  layout: { params: LayoutParams; result: LayoutResult };
  /** Read the daemon's files again and apply their layouts. All other changes are rejected; they need a restart. */
  reload: { params: Empty; result: ReloadResult };
  /** List the available effects. */
  effects: { params: Empty; result: EffectsResult };
  /** Play an effect, or points and taps, at a finger; only while armed. Returns the outcome: when it starts and at which level, or why it is not played. */
  play: { params: PlayParams; result: PlayResult };
  /** Set or show the strength of a source, client or region. The status shows all strengths. Active effects fade to the new strength within 100 ms. */
  strength: { params: StrengthParams; result: StrengthResult };
  /** Subscribe to notifications of topics. */
  subscribe: { params: SubscribeParams; result: Empty };
  /** Unsubscribe from notifications of topics. */
  unsubscribe: { params: UnsubscribeParams; result: Empty };
}
export type Method = keyof Methods;

/** The data of every topic of event notifications. */
export interface Topics {
  /** every change of state or epoch, with its cause */
  state: StateEvent;
  /** fingers touched, moved or lifted */
  contacts: ContactsEvent;
  /** the current playback, as confirmed by the amplifiers */
  pattern: PatternEvent;
  /** playback has ended, and why */
  silence: SilenceEvent;
  /** status of the amplifiers, at rate_hz */
  amplifiers: AmplifiersEvent;
  /** latency from touch to command, at rate_hz */
  latency: LatencyEvent;
  /** log records of level info and above, except state and link changes */
  log: LogEvent;
  /** an amplifier link was degraded, lost or reopened */
  link: LinkEvent;
  /** the surface layout was changed or replaced */
  layout: LayoutEvent;
  /** changes of touch inputs (lost, mute, restored) and rejected touches, every second */
  inputs: InputsEvent;
  /** strengths of sources, clients and regions, at rate_hz */
  strength: StrengthResult;
}
export type Topic = keyof Topics;

/** An event notification of any topic. */
export type Event = {
  [T in Topic]: { topic: T; time_s: number; lost: number; data: Topics[T] };
}[Topic];

/** A method's parameters as arguments, optional if all parameters are optional. */
export type Arguments<M extends Method> = {} extends Methods[M]["params"]
  ? [params?: Methods[M]["params"]]
  : [params: Methods[M]["params"]];

/** Name of the client, for the log. */
export interface HelloParams {
  client: string;
}

/** Rig, table and layout of the daemon; only the layout can change while it runs. */
export interface HelloResult {
  /** major.minor; major versions are incompatible */
  api_version: string;
  software_version: string;
  rig: RigSummary;
  table: TableSummary;
  /** the rig file, from which vibration fields can be computed */
  rig_text: string;
  /** the surface layout; null without one */
  layout: Record<string, unknown> | null;
  /** label, unit and decimals of the amplifier readings to show, by key of the status */
  readings?: Record<string, [string, string, number]>;
}

/** An empty object: no parameters, or no result. */
export interface Empty {
}

/** State of the daemon, the amplifiers and the plate. */
export interface StatusResult {
  /** cause of the state */
  cause: string;
  /** remedy; null if no action is needed */
  remedy: string | null;
  /** in order of arrival, newest last */
  contacts: Array<ContactStatus>;
  /** tones of the newest vibration by ERA; silent ERAs are omitted */
  drive: Record<string, PlayedTone>;
  /** tones of each vibration by layer, then by ERA, in the format of `drive`; an ERA plays the sum of its layers */
  layers?: Record<string, Record<string, PlayedTone>>;
  /** felt contrast, target over loudest quiet finger: at least this on 90 % of plates within the rig's tolerances; null for a single finger */
  promised_contrast_db?: number | null;
  /** the same on the nominal plate */
  predicted_contrast_db?: number | null;
  predicted_level_db_sl: number | null;
  /** gain in dB by name (0 if not set), for configured inputs, sources that have had fingers, connected clients, regions of the current layout, and all other names with a gain */
  strengths?: Record<string, number>;
  /** time of this response on CLOCK_MONOTONIC */
  time_s: number;
  /** the same time on the wall clock */
  unix_time_s: number;
  state: "NOT_READY" | "SWITCH_ON_DISABLED" | "READY_TO_SWITCH_ON" | "SWITCHED_ON" | "OPERATION_ENABLED" | "QUICK_STOP_ACTIVE" | "FAULT_REACTION_ACTIVE" | "FAULT" | "COMM_LOST";
  /** the state in plain words */
  word?: string;
  /** increases with every state change, stop, fault and loss; starts at random */
  epoch: number;
  /** whether lost amplifiers may still be playing */
  assume_energised: boolean;
  /** how long a link has been lost; null if all are up */
  lost_for_s: number | null;
  /** time without heartbeats after which an armed amplifier silences itself */
  watchdog_s: number;
  armed_by: string | null;
  lease_left_s: number | null;
  /** why nothing plays while armed */
  silence_reason?: string | null;
  amplifiers: Array<AmplifierStatus>;
  /** after a finger landed, moved or changed its pressure */
  latency_ms: LatencySummary;
  /** after a lift, or a change without a touch, such as the end of an effect */
  lift_latency_ms?: LatencySummary | null;
  /** number of rejected touches by reason, for all sources together */
  rejected_touches: Record<string, number>;
  /** content and source of the newest rejected touch for each reason */
  rejected_examples?: Record<string, string>;
  /** configured touch inputs */
  inputs?: Array<TouchInputStatus>;
  /** number of short vibrations that were too late to be felt; playback continues */
  clicks_too_late?: number;
  /** notifications that clients were too slow to read, by topic */
  lost_events?: Record<string, number>;
  /** name of the current layout; null if there is none */
  layout?: string | null;
  /** names that `layout` accepts */
  layouts?: Array<string>;
  /** why table queries take longer than necessary; null if they do not */
  slow_reason?: string | null;
  /** name of the rig's threshold set, to which levels in dB SL are relative */
  threshold?: string | null;
  uptime_s: number;
}

/** Who arms, and the duration of the lease without renewal. */
export interface ArmParams {
  owner: string;
  lease_s?: number;
}

/** The lease; renew it within lease_s. */
export interface ArmResult {
  lease_s: number;
  lease: string;
}

/** The lease that `arm` returned. */
export interface RenewParams {
  lease: string;
}

/** Time until the lease expires. */
export interface RenewResult {
  lease_s: number;
}

/** Whose lease to end. */
export interface DisarmParams {
  client?: string | null;
  /** disarm only if this lease is current; null: under any lease */
  lease?: string | null;
}

/** Client to name in the log, if the connection belongs to another one. */
export interface RequestedBy {
  client?: string | null;
}

/** Every amplifier is confirmed silent. */
export interface StopResult {
  /** increases with every state change, stop, fault and loss; starts at random */
  epoch: number;
  /** by name */
  amplifiers?: Record<string, AmplifierSilence>;
}

/** The epoch up to which to acknowledge; a later stop, fault or loss stays latched. */
export interface ClearParams {
  client?: string | null;
  /** as last received in a status, stop or state event; null: the current one */
  epoch?: number | null;
}

/** All fingers of a touch source; valid for 150 ms, so repeat it. */
export interface TouchParams {
  source: string;
  touches: Array<TouchPoint>;
}

/** The layout to use. */
export interface LayoutParams {
  /** one of `layouts` in the status */
  name: string;
}

/** The current layout, and all available ones. */
export interface LayoutResult {
  layout: string;
  layouts: Array<string>;
}

/** Result of reading the daemon's files again. */
export interface ReloadResult {
  /** whether the new files are in use; if not, nothing changed */
  reloaded: boolean;
  /** the changes, or the reasons for rejection */
  reasons: Array<string>;
}

/** The effects that `play` accepts. */
export interface EffectsResult {
  effects: Array<EffectDescription>;
}

/** Play an effect, or points, at the finger nearest to a position; they end when it lifts. */
export interface PlayParams {
  /** an effect of the layout or a built-in content; null with points or taps */
  effect?: string | null;
  /** a finger must be within 20 mm of the position */
  x_m: number;
  y_m: number;
  /** -20 or more. For an effect, default and maximum are its own level; for points, the default is 20 and the maximum is the layout's `max_level_db_sl` */
  level_db_sl?: number | null;
  /** continuous event: `[time_s, intensity, sharpness]` in order of time; 0 to 60 s, 0 to 1, 0 to 1 */
  points?: Array<Array<number>>;
  /** transients, in the same format */
  taps?: Array<Array<number>>;
  /** whether points or a file repeat from the start */
  loop?: boolean;
}

/** Outcome of a request to play, once the amplifiers have confirmed it or it was given up. */
export interface PlayResult {
  /** played: confirmed by the amplifiers; late: it was over, or had lost its touch, before they could play it; held back: not played, for a reason; pending: not yet, because it begins with a pause, waits for a movement, or was not decided within 2 s */
  outcome: "played" | "late" | "held back" | "pending";
  /** why it is not played, or why the finger shares another vibration; null otherwise */
  reason?: string | null;
  /** when the amplifiers start it, on CLOCK_MONOTONIC; the following values are null if it is not played */
  start_s?: number | null;
  /** null if it has several frequencies */
  frequency_hz?: number | null;
  /** predicted level on the nominal plate, relative to the rig's threshold set; over the duration of a short vibration, onset included */
  level_db_sl?: number | null;
  /** at least this level on 90 % of plates within the rig's tolerances */
  promised_level_db_sl?: number | null;
  /** felt contrast, target over loudest quiet finger: at least this on 90 % of plates within the rig's tolerances; null for a single finger */
  promised_contrast_db?: number | null;
  /** as in the status */
  verdict?: "own" | "mixed" | "shared" | null;
  /** all other fingers, in order of arrival */
  other_fingers?: Array<OtherFinger>;
}

/** A touch source, client or region and its gain; without a gain, nothing changes. */
export interface StrengthParams {
  /** name of an input, sender, source, client or region */
  name: string;
  /** applied to all its effects; 0 is the level that layout and limits allow */
  gain_db?: number | null;
}

/** Strengths of all known touch sources, clients and regions. */
export interface StrengthResult {
  /** gain in dB by name (0 if not set), for configured inputs, sources that have had fingers, connected clients, regions of the current layout, and all other names with a gain */
  strengths?: Record<string, number>;
}

/** Topics to subscribe to, and the rate of the periodic ones. */
export interface SubscribeParams {
  topics: Array<"state" | "contacts" | "pattern" | "silence" | "amplifiers" | "latency" | "log" | "link" | "layout" | "inputs" | "strength">;
  /** rate of the periodic topics; default 10 */
  rate_hz?: number | null;
}

/** Topics to unsubscribe from. */
export interface UnsubscribeParams {
  topics: Array<"state" | "contacts" | "pattern" | "silence" | "amplifiers" | "latency" | "log" | "link" | "layout" | "inputs" | "strength">;
}

/** The daemon changed state. */
export interface StateEvent {
  /** cause of the state */
  cause: string;
  /** remedy; null if no action is needed */
  remedy: string | null;
  old: "NOT_READY" | "SWITCH_ON_DISABLED" | "READY_TO_SWITCH_ON" | "SWITCHED_ON" | "OPERATION_ENABLED" | "QUICK_STOP_ACTIVE" | "FAULT_REACTION_ACTIVE" | "FAULT" | "COMM_LOST";
  new: "NOT_READY" | "SWITCH_ON_DISABLED" | "READY_TO_SWITCH_ON" | "SWITCHED_ON" | "OPERATION_ENABLED" | "QUICK_STOP_ACTIVE" | "FAULT_REACTION_ACTIVE" | "FAULT" | "COMM_LOST";
  /** the new state in plain words */
  word?: string;
  /** increases with every state change, stop, fault and loss; starts at random */
  epoch: number;
}

/** All contacts after a change, before a pattern is selected for them. */
export interface ContactsEvent {
  contacts: Array<ContactStatus>;
}

/** A pattern that the amplifiers confirmed. */
export interface PatternEvent {
  /** in order of arrival, newest last */
  contacts: Array<ContactStatus>;
  /** tones of the newest vibration by ERA; silent ERAs are omitted */
  drive: Record<string, PlayedTone>;
  /** tones of each vibration by layer, then by ERA, in the format of `drive`; an ERA plays the sum of its layers */
  layers?: Record<string, Record<string, PlayedTone>>;
  /** felt contrast, target over loudest quiet finger: at least this on 90 % of plates within the rig's tolerances; null for a single finger */
  promised_contrast_db?: number | null;
  /** the same on the nominal plate */
  predicted_contrast_db?: number | null;
  predicted_level_db_sl: number | null;
  /** from the touch to the last byte of the command; null if none was needed */
  latency_ms: number | null;
}

/** No channel is driven; if a link is lost (see the state), as far as is known. */
export interface SilenceEvent {
  contacts: Array<ContactStatus>;
  reason: string;
  /** null if no command was needed */
  latency_ms: number | null;
}

/** All amplifiers, at the subscribed rate. */
export interface AmplifiersEvent {
  amplifiers: Array<AmplifierStatus>;
}

/** Latencies, at the subscribed rate. */
export interface LatencyEvent {
  latency_ms: LatencySummary;
}

/** A record of the daemon's log. */
export interface LogEvent {
  level: "info" | "warning" | "error";
  message: string;
  cause: string | null;
  remedy: string | null;
}

/** The link to amplifiers was lost, could not be reopened, or was reopened. Degraded: an amplifier does not reply but may still play; nothing new is played until it replies (restored) or is lost. */
export interface LinkEvent {
  event: "degraded" | "restored" | "lost" | "retry" | "reopened";
  /** name of the amplifier, if known */
  amplifier: string | null;
  message: string;
  remedy: string | null;
}

/** The layout was changed or replaced; its effects can differ. */
export interface LayoutEvent {
  /** name of the current layout; null if there is none */
  name?: string | null;
  /** the surface layout; null without one */
  layout: Record<string, unknown> | null;
}

/** A touch input was opened, fell silent or was lost, or touches were rejected. */
export interface InputsEvent {
  /** all configured inputs */
  inputs: Array<TouchInputStatus>;
  /** number of rejected touches by reason, for all sources together */
  rejected_touches: Record<string, number>;
}

/** The data needed to draw the rig. */
export interface RigSummary {
  length_m: number;
  width_m: number;
  eras: Array<EraPosition>;
  /** whether any of its amplifiers is simulated */
  simulated: boolean;
  /** lowest and highest allowed by the rig */
  frequency_hz: Array<number>;
}

/** The current localization table. */
export interface TableSummary {
  /** identifies the plate and ERAs it was built for */
  fingerprint: string;
  /** drive mode, such as phased */
  mode: string;
  frequencies_hz: Array<number>;
  cells_x: number;
  cells_y: number;
}

/** A finger on the plate and its predicted sensation. */
export interface ContactStatus {
  source: string;
  id: number;
  x_m: number;
  y_m: number;
  /** target: feels the pattern; quiet: kept quiet; hand: a resting hand, and surplus: a finger beyond max_fingers, which count only as loads; null before the first decision */
  role?: "target" | "quiet" | "hand" | "surplus" | null;
  /** level of a target relative to the rig's threshold set (`threshold` of `status`): at least this if its vibration continues, on the nominal plate if it is short; null if unknown */
  level_db_sl?: number | null;
  /** at least this level on 90 % of plates within the rig's tolerances */
  promised_level_db_sl?: number | null;
  /** felt contrast, target over loudest quiet finger: at least this on 90 % of plates within the rig's tolerances; null for a single finger */
  promised_contrast_db?: number | null;
  /** predicted felt contrast, target over loudest quiet finger; null for a single finger */
  contrast_db?: number | null;
  /** the effect selected for it, if any */
  effect?: string | null;
  /** the effect that the finger feels: its own, or another finger's */
  feels?: string | null;
  /** how a target feels its vibration. own: separately; mixed: together with other vibrations (promised contrast below 12 dB, or others are felt during its pauses); shared: it feels another finger's vibration instead; held back: not at all */
  verdict?: "own" | "mixed" | "shared" | "held back" | null;
  /** requested frequency of its vibration, before rounding; null if it has several frequencies */
  frequency_hz?: number | null;
  /** crosstalk level of others' vibrations here, not exceeded on 90 % of plates, relative to the most sensitive published thresholds (not comparable with level_db_sl); null if there are no other vibrations */
  foreign_level_db_sl?: number | null;
  /** the same level relative to the rig's threshold set, like level_db_sl */
  rig_foreign_level_db_sl?: number | null;
  /** whether other vibrations can be felt here (foreign_level_db_sl above 0); with verdict own they are at least 12 dB weaker */
  is_foreign_felt?: boolean;
  /** crosstalk level at the finger's current position on the nominal plate, relative to the rig's threshold set; can exceed the promise while the finger moves; sent only in the status; null if there are no other vibrations */
  leak_db_sl?: number | null;
  /** why its own effect, or a click over its continuous effect, is not played; null if it is */
  held_back?: string | null;
  /** load on the plate relative to the rig's fingertip; 1 if not reported */
  load?: number;
}

/** An ERA's tone, confirmed by the amplifier. */
export interface PlayedTone {
  frequency_hz: number;
  /** 0 to 1 of the full stroke */
  level: number;
  phase_deg: number;
}

/** An amplifier's state from the last reply; unknown values are null. */
export interface AmplifierStatus {
  name: string;
  url: string;
  serial_number: string | null;
  /** CiA 402 name of the amplifier's own state */
  state: string | null;
  /** the state in plain words */
  word?: string | null;
  fault: string | null;
  /** reported level of each channel, 0 to 1 of the full stroke; empty if unknown */
  levels: Array<number>;
  high_voltage: boolean | null;
  /** time since its last reply */
  reply_age_s: number | null;
  /** RMS error of its clock relative to the others, estimated by the host; null for a single or unsynchronized amplifier */
  clock_skew_us?: number | null;
  /** whether the amplifier does not reply but may still play; no new vibration starts meanwhile */
  degraded?: boolean;
  /** whether the link to it is lost */
  lost: boolean;
  /** whether its link was closed, although it replied, because another amplifier is lost */
  closed_with_lost: boolean;
  /** reports from the last 10 s */
  reports?: Array<AmplifierReport>;
  /** while it does not reply: whether it is silent; null while it replies */
  silence?: AmplifierSilence | null;
  statistics: LinkCounters;
  /** of the amplifier */
  temperature_c: number | null;
  /** of the supply; 0: not measured */
  high_voltage_v: number | null;
}

/** Latency from the arrival of a touch frame to the last byte of its command, in ms. Computed from the latest patterns; median and percentiles are null before the first pattern. */
export interface LatencySummary {
  count: number;
  median: number | null;
  p99: number | null;
  p999: number | null;
  /** [upper edge in ms, number above the previous edge and up to this one]; values above the last edge are counted in the last */
  histogram: Array<[number, number]>;
}

/** A configured touch input and whether it works. */
export interface TouchInputStatus {
  name: string;
  url: string;
  /** mute: open, but silent although it should send; missing: not opened, or lost, and being retried; ended: a recording at its end */
  state: "open" | "mute" | "missing" | "ended";
  /** why it is mute or missing, and what to do; null if it is neither */
  problem?: string | null;
}

/** Whether an amplifier is silent, after a stop or while it does not reply. */
export interface AmplifierSilence {
  /** confirmed_silent: confirmed by a status after the stop; watchdog_elapsed: unconfirmed, but the watchdog should have silenced it by now */
  silence: "confirmed_silent" | "may_play" | "watchdog_elapsed";
  /** time until its watchdog should have silenced it; null if its watchdog is unknown or silence is confirmed */
  may_play_for_s: number | null;
  cause: string;
}

/** One finger of a touch frame. */
export interface TouchPoint {
  /** chosen by the client, constant from touch-down to lift */
  id: number;
  /** from the plate's south-west corner */
  x_m: number;
  /** from the plate's south-west corner, upwards */
  y_m: number;
  /** radius of the contact, if known; 12.5 mm or more is a resting hand */
  radius_m?: number | null;
}

/** An effect that `play` accepts. */
export interface EffectDescription {
  name: string;
  kind: string;
  description: string;
  /** parameters by name in a layout file, in SI units */
  parameters: Record<string, unknown>;
}

/** Another finger on the plate, and the vibrations of others that reach it. */
export interface OtherFinger {
  source: string;
  id: number;
  x_m: number;
  y_m: number;
  /** as in the status: not exceeded on 90 % of plates, relative to the most sensitive published thresholds; null if unknown or without vibrations of others */
  foreign_level_db_sl: number | null;
  /** the same level relative to the rig's threshold set */
  rig_foreign_level_db_sl: number | null;
}

/** Position of an ERA under the plate, from the south-west corner, and its wiring. */
export interface EraPosition {
  name: string;
  x_m: number;
  y_m: number;
  amplifier: string;
  channel: number;
}

/** A condition other than a fault that an amplifier reports while it continues to play. */
export interface AmplifierReport {
  /** cause of the state */
  cause: string;
  /** remedy; null if no action is needed */
  remedy: string | null;
  kind: "limited" | "interlock_open" | "hot" | "clock_not_steered" | "clock_jumped" | "clock_rate" | "clock_unsettled";
}

/** Counters of the link to an amplifier since it was opened; see the wire protocol. */
export interface LinkCounters {
  frames_out: number;
  frames_in: number;
  /** frames with a wrong checksum, length, format or version */
  invalid_frames: number;
  /** valid but unexpected frames */
  unexpected_frames: number;
  events: number;
  retries: number;
  timeouts: number;
  refusals: number;
  /** of the last request */
  round_trip_ms: number | null;
}
