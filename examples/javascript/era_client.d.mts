import { EventEmitter } from "node:events";
import type { Arguments, Event, HelloResult, LayoutResult, Method, Methods, StatusResult, StopResult, StrengthResult, Topic, Topics } from "./api.js";
export type * from "./api.js";

/** The socket of this user's daemon, as `era status` finds it. */
export function defaultSocket(environment?: Record<string, string | undefined>): string;

/** A request that the daemon refused; code: see "errors" on the page of the API. */
export class Refused extends Error {
  code: number;
  data: unknown;
}

/** A connection to the daemon; emits each topic with its data, "opened" after a loss, and "lost" with an Error. */
export class EraClient extends EventEmitter {
  static connect(path?: string, name?: string): Promise<EraClient>;
  hello: HelloResult;
  call<M extends Method>(method: M, ...params: Arguments<M>): Promise<Methods[M]["result"]>;
  status(): Promise<StatusResult>;
  subscribe(...topics: Topic[]): Promise<void>;
  arm(lease_s?: number): Promise<void>;
  disarm(): Promise<void>;
  stop(): Promise<StopResult>;
  strength(name: string, gain_db?: number | null): Promise<StrengthResult>;
  layout(name: string): Promise<LayoutResult>;
  touch(places: [x_m: number, y_m: number][], source?: string): Promise<unknown>;
  close(): void;
  on<T extends Topic>(topic: T, told: (data: Topics[T], event: Extract<Event, { topic: T }>) => void): this;
  on(name: "opened", told: (hello: HelloResult) => void): this;
  on(name: "lost", told: (error: Error) => void): this;
}
